"""Parameters of the dead-reckoning node."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from netpos.inertial.pdr_config import PdrConfig
from netpos.messages.topics import is_vue_id
from netpos.scenario import load_scenario
from netpos_node import declare
from rclpy.node import Node


@dataclass(frozen=True, slots=True, kw_only=True)
class PdrParameters:
    """Everything the node reads at start."""

    vue_id: str
    subscribers: int
    config: PdrConfig

    def __post_init__(self) -> None:
        if self.subscribers < 0:
            raise ValueError(f"parameter subscribers must be >= 0, got {self.subscribers}")


def declare_parameters(node: Node) -> PdrParameters:
    """Declare and read all parameters; every entry of ``PdrConfig`` is one, under its name (with
    a dot inside ``attitude`` and ``steps``).

    A scenario gives the defaults of its device, explicit values win.
    """
    vue_id = declare(node, "vue", "vue_1", "device whose imu and mag are read")
    if not is_vue_id(vue_id):
        raise ValueError(f"vue: {vue_id!r} is no device name; use letters, digits and _")
    text = "scenario (name or YAML) whose device gives the defaults"
    defaults = _of_device(declare(node, "scenario", "", text), vue_id)
    text = "carried (anyhow) or waist (worn at the lower back): chooses the other defaults"
    placement = declare(node, "placement", defaults.get("placement", "carried"), text)
    base = PdrConfig.from_mapping({**defaults, "placement": placement})
    values = {
        name: declare(node, name, list(value) if isinstance(value, tuple) else value, text)
        for name, value, text in base.entries()
    }
    text = "listen to imu once velocities have so many subscribers, and steps one less (30 s)"
    return PdrParameters(
        vue_id=vue_id,
        subscribers=declare(node, "subscribers", 0, text),
        config=PdrConfig.from_mapping({"placement": placement, **values}),
    )


def _of_device(scenario: str, vue_id: str) -> Mapping[str, Any]:
    if not scenario:
        return {}
    devices = dict(load_scenario(scenario).each_device)
    if vue_id not in devices:
        raise ValueError(f"vue: scenario {scenario} has {', '.join(devices)}, not {vue_id}")
    return devices[vue_id].dead_reckoning
