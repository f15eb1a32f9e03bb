"""`ros2 topic list | echo | hz | bw | info | type | pub`."""

from __future__ import annotations

import argparse
import statistics
import time
from collections import deque
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from shared import (
    DISCOVERY_S,
    WINDOW,
    as_yaml,
    field_of,
    fill,
    full_name,
    interface_class,
    subscribe,
    type_of,
    wait_for_discovery,
)

DELIVERY_S = 1.0


def add_parsers(commands: Any) -> None:
    """Declare `ros2 topic ...`."""
    topic = commands.add_parser("topic").add_subparsers(dest="verb", required=True)
    listing = topic.add_parser("list")
    listing.add_argument("-t", "--show-types", action="store_true")
    listing.set_defaults(run=list_topics)
    echo = topic.add_parser("echo")
    echo.add_argument("topic")
    echo.add_argument("type", nargs="?", help="package/msg/Type; default: the publishers' one")
    echo.add_argument("--once", action="store_true", help="print one message and exit")
    echo.add_argument("--field", help="print only this part, such as pose.pose.position.x")
    echo.set_defaults(run=echo_topic)
    for verb, run in (("hz", report_rate), ("bw", report_bandwidth)):
        one = topic.add_parser(verb)
        one.add_argument("topic")
        one.set_defaults(run=run)
    kind = topic.add_parser("type")
    kind.add_argument("topic")
    kind.set_defaults(run=show_type)
    info = topic.add_parser("info")
    info.add_argument("topic")
    info.add_argument("-v", "--verbose", action="store_true", help="name the ends and their QoS")
    info.set_defaults(run=show_info)
    pub = topic.add_parser("pub")
    pub.add_argument("topic")
    pub.add_argument("type", help="package/msg/Type")
    pub.add_argument("values", nargs="?", default="{}", help="fields as YAML")
    often = pub.add_mutually_exclusive_group()
    often.add_argument("-r", "--rate", type=float, default=1.0, help="messages a second (1)")
    often.add_argument("-1", "--once", action="store_true", help="one message, then exit")
    pub.add_argument("-t", "--times", type=int, default=0, help="so many messages, then exit")
    pub.add_argument("-w", "--wait-matching-subscriptions", type=int, default=None)
    pub.add_argument("--qos-durability", choices=["volatile", "transient_local"])
    pub.add_argument("--qos-reliability", choices=["reliable", "best_effort"])
    pub.set_defaults(run=publish)


def list_topics(node: Node, arguments: argparse.Namespace) -> int:
    """Print the topics of the graph, with their types where asked for."""
    wait_for_discovery(node)
    for name, types in sorted(node.get_topic_names_and_types()):
        print(f"{name} [{', '.join(types)}]" if arguments.show_types else name)
    return 0


def echo_topic(node: Node, arguments: argparse.Namespace) -> int:
    """Print messages as YAML documents until interrupted, or one with --once."""
    received: list[Any] = []
    subscribe(node, arguments.topic, received.append, wanted=arguments.type)
    while True:
        rclpy.spin_once(node)
        while received:
            message = received.pop(0)
            shown = field_of(message, arguments.field) if arguments.field else message
            print(as_yaml(shown), end="---\n", flush=True)
            if arguments.once:
                return 0


def _every_second(node: Node) -> Any:
    """Spin, and yield once a second."""
    due = time.monotonic() + 1.0
    while True:
        rclpy.spin_once(node, timeout_sec=max(0.0, due - time.monotonic()))
        if time.monotonic() >= due:
            due += 1.0
            yield


def report_rate(node: Node, arguments: argparse.Namespace) -> int:
    """Print the average rate of arrival once a second until interrupted."""
    arrivals: deque[float] = deque(maxlen=WINDOW + 1)
    subscribe(node, arguments.topic, lambda _: arrivals.append(time.monotonic()), raw=True)
    for _ in _every_second(node):
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
    return 0


def report_bandwidth(node: Node, arguments: argparse.Namespace) -> int:
    """Print the bytes per second once a second until interrupted."""
    arrived: deque[tuple[float, int]] = deque(maxlen=WINDOW)
    subscribe(
        node, arguments.topic, lambda cdr: arrived.append((time.monotonic(), len(cdr))), raw=True
    )
    print(f"Subscribed to [{full_name(arguments.topic)}]", flush=True)
    for _ in _every_second(node):
        if not arrived:
            print("no new messages", flush=True)
            continue
        sizes = [size for _, size in arrived]
        seconds = max(time.monotonic() - arrived[0][0], 1e-3)
        mean = statistics.fmean(sizes)
        print(f"{_size(sum(sizes) / seconds)}/s from {len(sizes)} messages", flush=True)
        limits = f"min: {_size(min(sizes))} max: {_size(max(sizes))}"
        print(f"\tMessage size mean: {_size(mean)} {limits}", flush=True)
    return 0


def _size(count: float) -> str:
    for unit, factor in (("MB", 1e6), ("KB", 1e3)):
        if count >= factor:
            return f"{count / factor:.2f} {unit}"
    return f"{count:.2f} B"


def show_type(node: Node, arguments: argparse.Namespace) -> int:
    """Print the type of a topic."""
    print(type_of(node, full_name(arguments.topic)))
    return 0


def show_info(node: Node, arguments: argparse.Namespace) -> int:
    """Print type and number of publishers and subscribers; with -v who they are."""
    topic = full_name(arguments.topic)
    print(f"Type: {type_of(node, topic)}\n")
    wait_for_discovery(node)
    ends = {
        "Publisher": node.get_publishers_info_by_topic(topic),
        "Subscription": node.get_subscriptions_info_by_topic(topic),
    }
    for kind, infos in ends.items():
        print(f"{kind} count: {len(infos)}" + ("\n" if arguments.verbose else ""))
        for info in infos if arguments.verbose else []:
            qos = info.qos_profile
            print(f"Node name: {info.node_name}\nNode namespace: {info.node_namespace}")
            print(f"Topic type: {info.topic_type}\nQoS profile:")
            print(f"  Reliability: {qos.reliability.name}\n  Durability: {qos.durability.name}\n")
    return 0


def publish(node: Node, arguments: argparse.Namespace) -> int:
    """Publish one message, some, or the same again and again until interrupted."""
    kind = interface_class(arguments.type)
    message = fill(kind(), arguments.values)
    qos = QoSProfile(depth=WINDOW, reliability=ReliabilityPolicy.RELIABLE)
    if arguments.qos_durability == "transient_local":
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
    if arguments.qos_reliability == "best_effort":
        qos.reliability = ReliabilityPolicy.BEST_EFFORT
    publisher = node.create_publisher(kind, full_name(arguments.topic), qos)
    count = 1 if arguments.once else arguments.times
    wanted = arguments.wait_matching_subscriptions
    _wait_for_subscribers(publisher, (1 if count else 0) if wanted is None else wanted)
    print("publisher: beginning loop", flush=True)
    done = 0
    while not count or done < count:
        if done:
            time.sleep(1.0 / arguments.rate)
        done += 1
        publisher.publish(message)
        print(f"publishing #{done}: {message}\n", flush=True)
    end_s = time.monotonic() + DELIVERY_S  # those who find a latched topic only now
    while time.monotonic() < end_s:
        rclpy.spin_once(node, timeout_sec=0.1)
    return 0


def _wait_for_subscribers(publisher: Any, wanted: int) -> None:
    warned = time.monotonic() + DISCOVERY_S
    while publisher.get_subscription_count() < wanted:
        if time.monotonic() > warned:
            print(f"Waiting for at least {wanted} matching subscription(s)...", flush=True)
            warned = float("inf")
        time.sleep(0.05)
