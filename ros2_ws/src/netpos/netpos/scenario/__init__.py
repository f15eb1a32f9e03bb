"""One YAML file is one reproducible run: load it, simulate it, write it to a bag."""

from netpos.scenario.load import ScenarioError, load_scenario, scenario_names
from netpos.scenario.schema import Scenario
from netpos.scenario.simulation import Simulation

__all__ = ["Scenario", "ScenarioError", "Simulation", "load_scenario", "scenario_names"]
