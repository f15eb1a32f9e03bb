"""What every node of netpos needs: how it starts and stops, its parameters, its QoS, its
messages."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from threading import Event, Thread
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import KeyValue
from netpos.bags import cdr_codec
from netpos.messages.codec import Codec
from netpos.messages.topics import to_resolve
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.duration import Duration
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    NotInitializedException,
)
from rclpy.executors import ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import uninstall_signal_handlers
from rclpy.subscription import Subscription

from netpos_node.arguments import check_arguments, refuse

Config = TypeVar("Config")

STREAM = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
# Of a subscription: what may wait while the node is busy. A stalled tracker hears 1500 messages
# per second from a bag of four arrays at ten times real time, and what does not fit is lost.
BACKLOG = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.RELIABLE)
RELAXED = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)  # heard of anybody
LATCHED = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

_COUNT_MAX = 2**31 - 1
_DELIVERY_S = 4.0  # whoever starts nodes kills one that takes much longer to end

_PROFILES = {
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(__file__).with_name("fastdds.xml")),
    "RMW_FASTRTPS_USE_QOS_FROM_XML": "1",
}


def choose_profiles(environment: MutableMapping[str, str]) -> None:
    """Let Fast DDS take the endpoints' memory policy and the rate of announcements from
    ``fastdds.xml``, unless the user has chosen profiles; before a context is initialised."""
    if not {*_PROFILES, "FASTDDS_DEFAULT_PROFILES_FILE"} & environment.keys():
        environment.update(_PROFILES)


def init(**options: Any) -> None:
    """``rclpy.init`` with these ``options``, of a process with our profiles."""
    choose_profiles(os.environ)
    rclpy.init(**options)


def message_class(type_name: str) -> Any:
    """The rclpy class of a type name such as ``nav_msgs/msg/Odometry``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


CODEC = Codec(message_class)
CDR = cdr_codec()  # the same for the bytes of messages


def spin_and_finish(node: Any) -> None:
    """Spin a node until it is stopped, then let it ``finish``: give out what still follows from
    all that has arrived, and see it delivered."""
    spin_until_stopped(node, node.finish)


def run(
    factory: Callable[[], Any],
    spin: Callable[[Any], None] = spin_and_finish,
    arguments: Sequence[str] = (),
) -> None:
    """Start a node, spin it, shut down; a bad parameter ends the process with one sentence and
    code 2. ``arguments``: those of the command line; ``--help`` tells the parameters, and what no
    node can take is refused."""
    with _ends_when_stopped():
        node = _made(factory)
        if arguments:
            check_arguments(node, arguments)
        spin(node)


def _made(factory: Callable[[], Any]) -> Any:
    try:
        init()
    except rclpy_implementation.RCLError as error:  # of the arguments after --ros-args
        refuse(str(error).partition(", at ")[0])
    try:
        return factory()
    except (
        ValueError,
        FileNotFoundError,
        InvalidParameterTypeException,
        InvalidParameterValueException,
    ) as error:
        refuse(str(error))


@contextmanager
def patience(doing: str, after_s: float = 5.0) -> Iterator[None]:
    """Say on the error output what is being done, if the block takes more than ``after_s`` of this
    process's own work: on a busy machine everything takes longer."""
    done, begun_s = Event(), time.process_time()

    def watch() -> None:
        while not done.wait(min(after_s, 0.2)):
            if time.process_time() - begun_s >= after_s:
                print(f"netpos: {doing}", file=sys.stderr, flush=True)
                return

    Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        done.set()


@contextmanager
def _ends_when_stopped() -> Iterator[None]:
    """SIGINT or SIGTERM ends the block quietly, also while a node starts: rclpy then shuts its
    context down, and all that needs one fails."""
    try:
        yield
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (
        NotInitializedException,
        rclpy_implementation.RCLError,
        rclpy_implementation.InvalidHandle,
    ):
        if rclpy.ok():
            raise
    finally:
        with suppress(rclpy_implementation.RCLError):  # that of a signal is under way
            rclpy.try_shutdown()


def wait_until_heard(
    publishers: Mapping[str, Publisher],
    required: Mapping[str, int],
    timeout_s: float,
    settle_s: float = 1.0,
) -> list[str]:
    """Wait until topics have the ``required`` subscribers and nobody new subscribes to any topic.

    Two nodes may take seconds to discover each other, whoever else they have found, and what a
    stream carries before that is lost: the number of subscribers is what tells. A recorder finds
    topics one after the other: ``settle_s`` of rest tells that it has found all. Returns the
    topics that are short of subscribers after ``timeout_s``. Discovery needs no spinning.
    """
    started_s = changed_s = time.monotonic()
    counts: dict[str, int] = {}
    while True:
        now_s, before = time.monotonic(), counts
        counts = {topic: pub.get_subscription_count() for topic, pub in publishers.items()}
        if counts != before:
            changed_s = now_s
        unheard = [topic for topic, wanted in required.items() if counts[topic] < wanted]
        if not unheard and now_s - changed_s >= settle_s:
            return []
        if now_s - started_s >= timeout_s + settle_s:
            return unheard
        time.sleep(0.02)


def spin_until_stopped(node: Node, finish: Callable[[], None]) -> None:
    """Spin until SIGINT or SIGTERM, then ``finish`` while the node can still publish.

    What arrives meanwhile is handed over in the order of arrival, and at a cost that does not
    depend on the number of topics.
    """
    stopping: list[int] = []
    uninstall_signal_handlers()  # those of rclpy shut the node down at once
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stopping.append(number))
    executor = EventsExecutor()
    executor.add_node(node)
    while not stopping:
        executor.spin_once(timeout_sec=0.05)
    finish()


def waiting(subscription: Subscription) -> Iterator[tuple[Any, Mapping[str, Any]]]:
    """What has arrived of a subscription, each message with what the middleware says of it."""
    kind = subscription.msg_type, subscription.raw
    with subscription.handle:
        while taken := subscription.handle.take_message(*kind):
            yield taken


def take_waiting(subscription: Subscription, on_message: Callable[[Any], None]) -> None:
    """Hand over all that has arrived of a subscription."""
    for message, _ in waiting(subscription):
        on_message(message)


def say_of_run(node: Node, topic: str, facts: Mapping[str, str]) -> Publisher:
    """Tell whoever records, now or later, what a recording should say of its run; the publisher,
    for more of it."""
    publisher = node.create_publisher(KeyValue, to_resolve(topic), LATCHED)
    for key, value in facts.items():
        publisher.publish(KeyValue(key=key, value=value))
    return publisher


def see_delivered(node: Node) -> None:
    """Wait until what a node has published is acknowledged: a second per topic at most, and
    ``_DELIVERY_S`` for all, whoever has stopped listening without a word."""
    end_s = time.monotonic() + _DELIVERY_S
    for publisher in node.publishers:
        left_s = max(end_s - time.monotonic(), 0.0)
        publisher.wait_for_all_acked(Duration(nanoseconds=round(1e9 * min(left_s, 1.0))))


def declare(
    node: Node,
    name: str,
    default: Any,
    text: str,
    *,
    low: int | None = None,
    read_only: bool = True,
) -> Any:
    """Declare one parameter and return its value; ``low``: the least of a number."""
    spec = ParameterDescriptor(description=text, read_only=read_only)
    if low is not None:
        spec.integer_range = [IntegerRange(from_value=low, to_value=_COUNT_MAX)]
    return node.declare_parameter(name, default, spec).value


def declare_config(
    node: Node,
    config_class: type[Config],
    defaults: Mapping[str, Any] | None = None,
    *,
    read_only: bool = True,
) -> Config:
    """Declare every field of a config dataclass as a parameter and build the config.

    Ranges and descriptions come from the fields' metadata (``low``, ``high``, ``text``), defaults
    from the dataclass, overridden by ``defaults``. Raises ``ValueError`` for a bad value.
    """
    plain = config_class()
    values = {}
    for entry in fields(config_class):  # type: ignore[arg-type]
        default = (defaults or {}).get(entry.name, getattr(plain, entry.name))
        spec = ParameterDescriptor(description=entry.metadata.get("text", ""), read_only=read_only)
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
