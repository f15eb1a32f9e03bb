"""What every node of netpos needs: how it starts and stops, its parameters, its QoS, its
messages."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

import rclpy
from netpos.messages.codec import Codec
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

Config = TypeVar("Config")

STREAM = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def message_class(type_name: str) -> Any:
    """The rclpy class of a type name such as ``nav_msgs/msg/Odometry``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


CODEC = Codec(message_class)


def run(factory: Callable[[], Node], spin: Callable[[Node], None] = rclpy.spin) -> None:
    """Start a node, spin it, shut down; a bad parameter ends the process with one sentence and
    code 2."""
    rclpy.init()
    try:
        node = factory()
    except (
        ValueError,
        FileNotFoundError,
        InvalidParameterTypeException,
        InvalidParameterValueException,
    ) as error:
        rclpy.try_shutdown()
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    try:
        spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


def declare(node: Node, name: str, default: Any, text: str) -> Any:
    """Declare one read-only parameter and return its value."""
    spec = ParameterDescriptor(description=text, read_only=True)
    return node.declare_parameter(name, default, spec).value


def declare_config(
    node: Node, config_class: type[Config], defaults: Mapping[str, Any] | None = None
) -> Config:
    """Declare every field of a config dataclass as a read-only parameter and build the config.

    Ranges and descriptions come from the fields' metadata (``low``, ``high``, ``text``), defaults
    from the dataclass, overridden by ``defaults``. Raises ``ValueError`` for a bad value.
    """
    plain = config_class()
    values = {}
    for entry in fields(config_class):  # type: ignore[arg-type]
        default = (defaults or {}).get(entry.name, getattr(plain, entry.name))
        spec = ParameterDescriptor(description=entry.metadata.get("text", ""), read_only=True)
        if isinstance(default, int) and not isinstance(default, bool) and "low" in entry.metadata:
            limits = IntegerRange(
                from_value=entry.metadata["low"], to_value=entry.metadata["high"]
            )
            spec.integer_range = [limits]
        elif isinstance(default, float):
            spec.floating_point_range = [
                FloatingPointRange(
                    from_value=float(entry.metadata["low"]),
                    to_value=float(entry.metadata["high"]),
                )
            ]
        values[entry.name] = node.declare_parameter(entry.name, default, spec).value
    return config_class(**values)
