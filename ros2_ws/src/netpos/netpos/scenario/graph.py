"""Which nodes make a graph, with which arguments: the one description that the launch files and
the shell scripts start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from netpos.scenario.load import load_scenario
from netpos.scenario.settings import settings_from

RECORDER, FUSION, TRACKERS, RSUS, WALKERS, SOURCE = STAGES = (
    "recorder",
    "fusion",
    "trackers",
    "rsus",
    "walkers",
    "source",
)
"""In the order of starting: who listens comes before who speaks."""


@dataclass(frozen=True, slots=True)
class GraphNode:
    """One process of a graph. ``parameters`` are ROS parameters, ``arguments`` come before them;
    ``params_file``: a file of parameters; ``name``: of the node."""

    stage: str
    name: str
    package: str
    executable: str
    arguments: tuple[str, ...] = ()
    parameters: Mapping[str, Any] = field(default_factory=dict)
    params_file: str = ""

    @property
    def command(self) -> list[str]:
        """What follows ``ros2 run``."""
        ros: list[str] = []
        if self.name not in (self.executable, f"netpos_{self.executable}"):
            ros += ["-r", f"__node:={self.name}"]
        if self.params_file:
            ros += ["--params-file", self.params_file]
        for name, value in self.parameters.items():
            text = f"{value:.6f}" if isinstance(value, float) else f"{value}"  # 5.0, never 5
            ros += ["-p", f"{name}:={text}"]
        tail = ["--ros-args", *ros] if ros or self.stage == TRACKERS else []
        return [self.package, self.executable, *self.arguments, *tail]


def run_of(scenario: str, bag: str = "", rate: float = 1.0, seed: int = -1) -> list[GraphNode]:
    """The graph that simulates a scenario (name or YAML file) and tracks it. ``bag``: where it is
    recorded; empty: nowhere.

    Raises ``ValueError`` for a scenario that cannot be used.
    """
    heard = int(bool(bag))
    trackers = trackers_of(scenario, heard)
    count = sum(node.stage == TRACKERS for node in trackers)
    common: dict[str, Any] = {"scenario": scenario}
    return [
        *_recorder(bag, "--log-time", "clock"),
        *trackers,
        GraphNode(
            RSUS,
            *("rsu_sensor",) * 3,
            parameters={**common, "seed": seed, "subscribers": heard + count},
        ),
        *(
            GraphNode(
                WALKERS,
                f"pdr_{vue}",
                *("pdr_node",) * 2,
                parameters={"vue": vue, **common, "subscribers": 1 + heard},
            )
            for vue in load_scenario(scenario).walkers
        ),
        GraphNode(
            SOURCE,
            *("vue_sim",) * 3,
            parameters={**common, "seed": seed, "rate": float(rate), "subscribers": 1 + heard},
        ),
    ]


def play_of(source: str, bag: str, rate: float = 1.0) -> list[GraphNode]:
    """The graph that plays the measurements of a bag to trackers and records them again."""
    trackers = trackers_of(source, 1)
    count = 1 + sum(node.stage == TRACKERS for node in trackers)
    flags = ("--rate", f"{rate:g}", "--input-only", "--subscribers", str(count))
    arguments = (source, *flags, "--wait-timeout", "60")
    return [
        *_recorder(bag, "--log-time", "clock"),
        *trackers,
        GraphNode(SOURCE, "netpos_play", "netpos_bag", "play", arguments),
    ]


def tracker_of(params_file: str = "", bag: str = "") -> list[GraphNode]:
    """The tracker alone, for RSUs that are there."""
    alone = GraphNode(TRACKERS, *("ekf_tracker",) * 3, params_file=params_file)
    return [*_recorder(bag), alone]


def trackers_of(source: str, subscribers: int = 0) -> list[GraphNode]:
    """One tracker, or one for each network of a scenario or bag and the fusion of their tracks.
    They wait until each estimate has so many ``subscribers``."""
    networks = settings_from(source).networks
    common: dict[str, Any] = {"scenario": source, "subscribers": subscribers}
    if not networks:
        return [GraphNode(TRACKERS, *("ekf_tracker",) * 3, parameters=common)]
    return [
        GraphNode(FUSION, *("track_fusion",) * 3, parameters=common),
        *(
            GraphNode(
                TRACKERS,
                f"ekf_tracker_{network}",
                *("ekf_tracker",) * 2,
                parameters={"network": network, **common},
            )
            for network in networks
        ),
    ]


def _recorder(bag: str, *flags: str) -> list[GraphNode]:
    arguments = ("--output", bag, *flags)
    record = GraphNode(RECORDER, "netpos_record", "netpos_bag", "record", arguments)
    return [record] if bag else []
