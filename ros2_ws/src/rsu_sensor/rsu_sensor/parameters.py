"""Parameters of the RSU node."""

from __future__ import annotations

from dataclasses import dataclass

from netpos.scenario import Scenario, Simulation, load_scenario
from netpos_node import declare
from rclpy.node import Node


@dataclass(frozen=True, slots=True, kw_only=True)
class RsuParameters:
    """Everything the node reads at start; ``rsu_ids`` are the RSUs this process hosts."""

    simulation: Simulation
    rsu_ids: frozenset[str]
    subscribers: int

    @property
    def scenario(self) -> Scenario:
        """The scenario that places the RSUs."""
        return self.simulation.scenario


def hosted(simulation: Simulation, wanted: list[str]) -> frozenset[str]:
    """The RSUs to host: those wanted, or all where none is named; ``ValueError`` for unknown
    ids."""
    known = {rsu.rsu_id for rsu in simulation.rsus}
    unknown = sorted(set(wanted) - known - {""})
    if unknown:
        raise ValueError(
            f"parameter rsus names {', '.join(unknown)}, "
            f"but scenario {simulation.scenario.name} has {', '.join(sorted(known))}"
        )
    return frozenset(set(wanted) & known or known)


def declare_parameters(node: Node) -> RsuParameters:
    """Declare and read all parameters; raises ``ValueError`` for a bad value."""
    name = declare(node, "scenario", "metis_madrid", "scenario: its name or the path of a YAML")
    seed = declare(node, "seed", -1, "seed of all draws; -1: the scenario's")
    wanted = declare(node, "rsus", [""], "ids of the RSUs this process hosts; empty: all")
    simulation = Simulation(load_scenario(name, None if seed == -1 else seed))
    text = "listen to beacons once the measurements have so many subscribers (or after 30 s)"
    return RsuParameters(
        simulation=simulation,
        rsu_ids=hosted(simulation, list(wanted)),
        subscribers=declare(node, "subscribers", 0, text),
    )
