"""The commands of the `ros2` stand-in that look into the graph: topic, node and interface."""

from __future__ import annotations

import argparse
import importlib
import statistics
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import yaml
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

DISCOVERY_S = 1.0  # how long lists wait for the graph to become known
WINDOW = 1000  # messages a rate is taken over


def main() -> int:
    """Run one command; the exit code follows the real tool's: 0 done, 1 failed, 2 bad usage."""
    arguments = parse_arguments()
    if arguments.command == "interface":
        return show_interface(arguments.type)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is a KeyboardInterrupt
    node = Node(f"ros2_standin_{time.monotonic_ns()}", start_parameter_services=False)
    try:
        return int(arguments.run(node, arguments))
    except KeyboardInterrupt:
        return 130
    except (BrokenPipeError, ImportError, LookupError) as error:
        print(f"ros2: {error}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()


def parse_arguments() -> argparse.Namespace:
    """Parse `ros2 COMMAND VERB ...`."""
    parser = argparse.ArgumentParser(prog="ros2", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    topic = commands.add_parser("topic").add_subparsers(dest="verb", required=True)
    listing = topic.add_parser("list")
    listing.add_argument("-t", "--show-types", action="store_true")
    listing.set_defaults(run=list_topics)
    echo = topic.add_parser("echo")
    echo.add_argument("topic")
    echo.add_argument("--once", action="store_true", help="print one message and exit")
    echo.set_defaults(run=echo_topic)
    rate = topic.add_parser("hz")
    rate.add_argument("topic")
    rate.set_defaults(run=report_rate)
    nodes = commands.add_parser("node").add_subparsers(dest="verb", required=True)
    nodes.add_parser("list").set_defaults(run=list_nodes)
    interface = commands.add_parser("interface").add_subparsers(dest="verb", required=True)
    interface.add_parser("show").add_argument("type", help="package/msg/Type")
    return parser.parse_args()


def list_topics(node: Node, arguments: argparse.Namespace) -> int:
    """Print the topics of the graph, with their types where asked for."""
    wait_for_discovery(node)
    for name, types in sorted(node.get_topic_names_and_types()):
        print(f"{name} [{', '.join(types)}]" if arguments.show_types else name)
    return 0


def list_nodes(node: Node, arguments: argparse.Namespace) -> int:
    """Print the full names of the other nodes."""
    wait_for_discovery(node)
    for name, namespace in sorted(node.get_node_names_and_namespaces()):
        if name != node.get_name():
            print(f"{namespace.rstrip('/')}/{name}")
    return 0


def echo_topic(node: Node, arguments: argparse.Namespace) -> int:
    """Print messages as YAML documents until interrupted, or one with --once."""
    received: list[Any] = []
    subscribe(node, arguments.topic, received.append)
    while True:
        rclpy.spin_once(node)
        while received:
            document = yaml.safe_dump(
                as_plain(received.pop(0)), sort_keys=False, default_flow_style=None
            )
            print(document, end="---\n", flush=True)
            if arguments.once:
                return 0


def report_rate(node: Node, arguments: argparse.Namespace) -> int:
    """Print the average rate of arrival once a second until interrupted."""
    arrivals: deque[float] = deque(maxlen=WINDOW + 1)
    subscribe(node, arguments.topic, lambda _: arrivals.append(time.monotonic()), raw=True)
    due = time.monotonic() + 1.0
    while True:
        rclpy.spin_once(node, timeout_sec=max(0.0, due - time.monotonic()))
        if time.monotonic() < due:
            continue
        due += 1.0
        if len(arrivals) < 2:
            print("no new messages", flush=True)
            continue
        gaps = [
            later - earlier for earlier, later in zip(arrivals, list(arrivals)[1:], strict=False)
        ]
        print(f"average rate: {len(gaps) / sum(gaps):.3f}", flush=True)
        print(
            f"\tmin: {min(gaps):.4f}s max: {max(gaps):.4f}s "
            f"std dev: {statistics.pstdev(gaps):.5f}s window: {len(gaps)}",
            flush=True,
        )


def subscribe(node: Node, topic: str, callback: Any, *, raw: bool = False) -> None:
    """Subscribe as the topic's publishers offer it (type, quality of service); wait for one."""
    name = topic if topic.startswith("/") else f"/{topic}"
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
    node.create_subscription(message_class(publishers[0].topic_type), name, callback, qos, raw=raw)


def message_class(type_name: str) -> type[Any]:
    """Return the class of ``package/msg/Type``; ImportError where its package is not built."""
    package, _, name = type_name.split("/")
    message_type: type[Any] = getattr(importlib.import_module(f"{package}.msg"), name)
    return message_type


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


def show_interface(type_name: str) -> int:
    """Print the definition file of ``package/msg/Type``."""
    package, _, rest = type_name.partition("/")
    try:
        share = Path(get_package_share_directory(package))
    except (PackageNotFoundError, ValueError):
        print(f"ros2: unknown package '{package}' in '{type_name}'", file=sys.stderr)
        return 1
    kind, _, name = rest.rpartition("/")
    path = share / (kind or "msg") / f"{name}.{kind or 'msg'}"
    if not path.is_file():
        print(f"ros2: no interface '{type_name}', expected package/msg/Type", file=sys.stderr)
        return 1
    print(path.read_text(encoding="utf-8"), end="")
    return 0


def wait_for_discovery(node: Node) -> None:
    """Let the middleware find the other processes."""
    end = time.monotonic() + DISCOVERY_S
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)


if __name__ == "__main__":
    sys.exit(main())
