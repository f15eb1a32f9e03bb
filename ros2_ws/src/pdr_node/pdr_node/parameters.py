"""Parameters of the dead-reckoning node."""

from __future__ import annotations

from dataclasses import dataclass, fields

from netpos.inertial.pdr import PdrConfig
from netpos.messages.topics import is_vue_id
from netpos_node import declare
from rclpy.node import Node


@dataclass(frozen=True, slots=True, kw_only=True)
class PdrParameters:
    """Everything the node reads at start."""

    vue_id: str
    config: PdrConfig


def declare_parameters(node: Node) -> PdrParameters:
    """Declare and read all parameters; every number of ``PdrConfig`` is one, under its name."""
    plain = PdrConfig()
    numbers = [e.name for e in fields(PdrConfig) if isinstance(getattr(plain, e.name), float)]
    values = {name: declare(node, name, getattr(plain, name), "see PdrConfig") for name in numbers}
    vue_id = declare(node, "vue", "vue_1", "device whose imu and mag are read")
    if not is_vue_id(vue_id):
        raise ValueError(f"vue: {vue_id!r} is no device name; use letters, digits and _")
    return PdrParameters(vue_id=vue_id, config=PdrConfig(**values))
