"""One YAML file is one reproducible run: load it, simulate it, write it to a bag.

The names of this package are imported when they are first used: a tracker that reads its
parameters (``settings``) needs neither a simulator nor what that one imports.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from netpos.common.lazy import imported_when_used

if TYPE_CHECKING:
    from netpos.scenario.load import ScenarioError, load_scenario, scenario_names
    from netpos.scenario.schema import Scenario
    from netpos.scenario.simulation import Simulation

__all__ = ["Scenario", "ScenarioError", "Simulation", "load_scenario", "scenario_names"]

__getattr__ = imported_when_used(__name__, "schema", "load", "simulation")
