"""Parameters of the device simulator."""

from __future__ import annotations

from dataclasses import dataclass

from netpos.scenario import Scenario, load_scenario
from netpos_node import declare
from rclpy.node import Node


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatorParameters:
    """Everything the node reads at start."""

    scenario: Scenario
    rate: float
    clock_hz: float
    subscribers: int
    wait_for_subscribers_s: float
    settle_s: float
    shutdown_at_end: bool

    def __post_init__(self) -> None:
        if not 0 < self.rate <= 1000:
            raise ValueError(f"parameter rate must be above 0 and at most 1000, got {self.rate}")
        if not 0 < self.clock_hz <= 10_000:
            raise ValueError(
                f"parameter clock_hz must be above 0 and at most 10000, got {self.clock_hz}"
            )
        if self.subscribers < 0:
            raise ValueError(f"parameter subscribers must be >= 0, got {self.subscribers}")
        for name in ("wait_for_subscribers_s", "settle_s"):
            if not 0 <= getattr(self, name) <= 3600:
                raise ValueError(
                    f"parameter {name} must be between 0 and 3600, got {getattr(self, name)}"
                )


def declare_parameters(node: Node) -> SimulatorParameters:
    """Declare and read all parameters; raises ``ValueError`` for a bad value."""
    name = declare(node, "scenario", "metis_madrid", "scenario: its name or the path of a YAML")
    seed = declare(node, "seed", -1, "seed of all draws; -1: the scenario's")
    return SimulatorParameters(
        scenario=load_scenario(name, None if seed == -1 else seed),
        rate=declare(node, "rate", 1.0, "speed against real time"),
        clock_hz=declare(node, "clock_hz", 100.0, "/clock messages per simulated second"),
        subscribers=declare(
            node, "subscribers", 1, "wait until beacon and initialpose have so many subscribers"
        ),
        wait_for_subscribers_s=declare(
            node, "wait_for_subscribers_s", 30.0, "longest wait for these subscribers"
        ),
        settle_s=declare(
            node, "settle_s", 1.0, "start once no subscriber (a recorder) has come for so long"
        ),
        shutdown_at_end=declare(
            node, "shutdown_at_end", True, "end the process with the scenario"
        ),
    )
