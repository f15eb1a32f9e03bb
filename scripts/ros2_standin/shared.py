"""What the commands of the stand-in share: messages as plain values, discovery, calls."""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import rclpy
import yaml
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

DISCOVERY_S = 1.0  # how long lists wait for the graph to become known
ANSWER_S = 10.0  # how long a service may take
WINDOW = 1000  # messages a rate is taken over


class CommandError(Exception):
    """A command failed; its text is for the user."""


def interface_class(type_name: str, kind: str = "msg") -> Any:
    """The class of ``package/msg/Type`` or ``package/Type``; CommandError where there is none."""
    package, _, rest = type_name.partition("/")
    name = rest.removeprefix(f"{kind}/")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError, ValueError):
        raise CommandError(
            f"no interface {type_name!r}, expected package/{kind}/Type; 'ros2 interface list'"
            " names what there is"
        ) from None


def as_plain(value: Any) -> Any:
    """Turn a message into dictionaries, lists and numbers, in field order."""
    if hasattr(value, "get_fields_and_field_types"):
        return {
            field: as_plain(getattr(value, field)) for field in value.get_fields_and_field_types()
        }
    if isinstance(value, np.ndarray | list | tuple) or hasattr(value, "typecode"):
        return [as_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, bytes):
        return list(value)
    return value


def as_yaml(message: Any) -> str:
    """A message, or a part of one, as a YAML document."""
    plain = as_plain(message)
    if not isinstance(plain, dict | list):
        return f"{plain}\n"
    return str(yaml.safe_dump(plain, sort_keys=False, default_flow_style=None))


def field_of(message: Any, path: str) -> Any:
    """A part of a message: ``pose.pose.position.x`` or ``status[0].name``."""
    value = message
    for name in path.replace("[", ".[").split("."):
        try:
            value = value[int(name[1:-1])] if name.startswith("[") else getattr(value, name)
        except (AttributeError, IndexError, ValueError, TypeError):
            raise CommandError(f"the message has no field {path!r}") from None
    return value


def fill(message: Any, text: str) -> Any:
    """Set the fields that a YAML text names."""
    try:
        values = yaml.safe_load(text or "{}") or {}
    except yaml.YAMLError as error:
        raise CommandError(f"no YAML: {error}") from None
    if not isinstance(values, Mapping):
        raise CommandError(f"give the fields as '{{name: value}}', got {text!r}")
    _set_fields(message, values)
    return message


def _set_fields(message: Any, values: Mapping[str, Any]) -> None:
    kinds = message.get_fields_and_field_types()
    for name, value in values.items():
        if name not in kinds:
            raise CommandError(f"no field {name!r}; there are {', '.join(kinds)}")
        now = getattr(message, name)
        if hasattr(now, "get_fields_and_field_types"):
            if not isinstance(value, Mapping):
                raise CommandError(f"{name}: give '{{field: value}}', got {value!r}")
            _set_fields(now, value)
            continue
        try:
            setattr(message, name, _typed(kinds[name], value))
        except (AssertionError, TypeError, ValueError) as error:
            raise CommandError(
                f"{name} ({kinds[name]}): {value!r} does not fit ({error})"
            ) from None


def _typed(kind: str, value: Any) -> Any:
    """A value of YAML as a field of this kind takes it."""
    if kind.startswith("sequence<") or kind.endswith("]"):
        inner = (
            kind.removeprefix("sequence<").removesuffix(">").partition("[")[0].partition(",")[0]
        )
        return [_typed(inner, item) for item in value]
    if "/" in kind:
        return fill(interface_class(kind)(), yaml.safe_dump(value))
    if kind in ("float", "double"):
        return float(value)
    if kind == "octet":
        return bytes([value])
    return value


def full_name(name: str) -> str:
    """A name as the graph has it."""
    return name if name.startswith("/") else f"/{name}"


def nodes(node: Node) -> list[str]:
    """Full names of the other nodes."""
    found = node.get_node_names_and_namespaces()
    return sorted(f"{s.rstrip('/')}/{n}" for n, s in found if n != node.get_name())


def find_node(node: Node, name: str) -> tuple[str, str]:
    """Name and namespace of a node of the graph; CommandError where it is not there."""
    wanted = full_name(name)
    end_s = time.monotonic() + 5.0 * DISCOVERY_S
    while wanted not in nodes(node):
        if time.monotonic() > end_s:
            raise CommandError(f"Node not found: {wanted}; there are {nodes(node) or 'none'}")
        rclpy.spin_once(node, timeout_sec=0.1)
    space, _, short = wanted.rpartition("/")
    return short, space or "/"


def call(node: Node, service_class: Any, name: str, request: Any) -> Any:
    """The answer of a service; CommandError where none comes."""
    client = node.create_client(service_class, name)
    if not client.wait_for_service(ANSWER_S):
        raise CommandError(f"no service {name} within {ANSWER_S:g} s")
    future = client.call_async(request)
    rclpy.spin_until_future_complete(node, future, timeout_sec=ANSWER_S)
    if not future.done():
        raise CommandError(f"{name} has not answered within {ANSWER_S:g} s")
    return future.result()


def type_of(node: Node, topic: str) -> str:
    """The type of a topic, once somebody publishes it or listens to it."""
    end_s = time.monotonic() + 5.0 * DISCOVERY_S
    while time.monotonic() < end_s:
        for name, types in node.get_topic_names_and_types():
            if name == topic:
                return str(types[0])
        rclpy.spin_once(node, timeout_sec=0.05)
    raise CommandError(f"Unknown topic {topic!r}; 'ros2 topic list' names what there is")


def subscribe(
    node: Node, topic: str, callback: Any, *, wanted: str | None = None, raw: bool = False
) -> None:
    """Subscribe as the topic's publishers offer it (type, quality of service); wait for one.

    Raises ``CommandError`` where their type is not the ``wanted`` one.
    """
    name = full_name(topic)
    publishers = node.get_publishers_info_by_topic(name)
    warned = time.monotonic() + DISCOVERY_S
    while not publishers:
        rclpy.spin_once(node, timeout_sec=0.05)
        publishers = node.get_publishers_info_by_topic(name)
        if time.monotonic() > warned:
            print(f"ros2: nobody publishes {name} yet, waiting", file=sys.stderr)
            warned = float("inf")
    profiles = [publisher.qos_profile for publisher in publishers]
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    qos = QoSProfile(
        depth=WINDOW,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    offered = publishers[0].topic_type
    kind = interface_class(offered)
    if wanted is not None and interface_class(wanted) is not kind:
        raise CommandError(f"{name} has the type {offered}, not {wanted}")
    node.create_subscription(kind, name, callback, qos, raw=raw)


def wait_for_discovery(node: Node) -> None:
    """Let the middleware find the other processes."""
    end = time.monotonic() + DISCOVERY_S
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
