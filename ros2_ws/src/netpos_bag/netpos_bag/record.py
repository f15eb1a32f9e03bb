"""Record the topics of a running graph: ``ros2 run netpos_bag record --output DIR``."""

from __future__ import annotations

import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import rclpy
from netpos import __version__
from netpos.bags import BagError, BagWriter
from netpos.messages.topics import CLOCK
from netpos_node import init, message_class
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from netpos_bag.conversions import clock_ns, profile_to_bag, profile_to_record, unique
from netpos_bag.parameters import RecordConfig, record_config, record_flags
from netpos_bag.recording import Recording

POLL_S = 0.05
FLUSH_S = 0.25
DRAIN_S = 0.3  # after the signal to stop, what is on its way still arrives
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"


class RecordNode(Node):
    """Subscribes to topics as they appear and writes what they bring."""

    def __init__(self, flags: dict[str, Any]) -> None:
        super().__init__("netpos_record")
        self.config: RecordConfig = record_config(self, flags)
        pairs = (item.partition("=") for item in self.config.metadata)
        run = {"netpos_version": __version__} | {key: value for key, _, value in pairs}
        self.writer = BagWriter(self.config.output, metadata=run)
        self.recording = Recording(self.writer, self.config.log_time)
        self.lost: Counter[str] = Counter()
        self._known: set[str] = set()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(POLL_S, self._look_for_topics, clock=steady)
        self.create_timer(FLUSH_S, self._tick, clock=steady)
        self._look_for_topics()

    def _look_for_topics(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            if topic not in self._known and self.count_publishers(topic):
                self._known.add(topic)
                self._subscribe(topic, types)

    def _subscribe(self, topic: str, types: list[str]) -> None:
        wanted = not self.config.topics or topic in self.config.topics
        if not wanted and topic != CLOCK:
            return
        if len(types) > 1:
            self._leave_out(topic, f"it has several types: {', '.join(types)}")
            return
        offered = unique(
            profile_to_bag(info.qos_profile) for info in self.get_publishers_info_by_topic(topic)
        )
        try:
            kind = message_class(types[0])
            if wanted:
                self.writer.add_topic(topic, types[0], offered)
        except (BagError, ImportError, AttributeError) as error:
            self._leave_out(topic, str(error))
            return
        events = SubscriptionEventCallbacks(
            message_lost=partial(self._on_lost, topic),
            incompatible_qos=partial(self._on_incompatible, topic),
        )
        receive = self._on_clock if topic == CLOCK else self._on_message
        self.create_subscription(
            kind,
            topic,
            partial(receive, topic, types[0], wanted),
            profile_to_record(offered),
            event_callbacks=events,
            raw=True,
        )

    def _leave_out(self, topic: str, reason: str) -> None:
        self.get_logger().warning(f"{topic} is not recorded: {reason}")

    def _on_lost(self, topic: str, event: Any) -> None:
        self.lost[topic] += event.total_count_change
        self.get_logger().warning(
            f"{topic}: {self.lost[topic]} messages lost", throttle_duration_sec=2.0
        )

    def _on_incompatible(self, topic: str, event: Any) -> None:
        self.get_logger().warning(
            f"{topic}: a publisher offers less than the first one did; it is not recorded"
        )

    def _on_clock(self, topic: str, type_name: str, wanted: bool, cdr: bytes) -> None:
        self.recording.clock(clock_ns(cdr))
        if wanted:
            self._on_message(topic, type_name, wanted, cdr)

    def _on_message(self, topic: str, type_name: str, wanted: bool, cdr: bytes) -> None:
        self.recording.message(topic, type_name, cdr, time.time_ns())

    def _tick(self) -> None:
        jumps = self.recording.backward_jumps
        self.recording.tick(time.time_ns(), self.count_publishers(CLOCK) > 0)
        if jumps:
            self.get_logger().warning(
                f"/clock went back {jumps} times; the bag mixes what came before and after",
                throttle_duration_sec=10.0,
            )

    def report(self) -> str:
        """Counts per topic, and what was lost."""
        counts = self.writer.counts
        lines = [f"{self.config.output}: {sum(counts.values())} messages"]
        lines += [f"  {topic}: {count}" for topic, count in sorted(counts.items())]
        missing = sorted(set(self.config.topics) - counts.keys())
        lines += [f"  MISSING {topic}: nothing was published" for topic in missing]
        lines += [f"  LOST {topic}: {count}" for topic, count in sorted(self.lost.items())]
        return "\n".join(lines)


def spin_until(executor: SingleThreadedExecutor, done: Callable[[], bool], seconds: float) -> None:
    """Spin until ``done``, at most ``seconds``."""
    end = time.monotonic() + seconds
    while not done() and time.monotonic() < end:
        executor.spin_once(timeout_sec=POLL_S)


def main() -> None:
    """Record until SIGINT or SIGTERM; exit 0, or 2 where the options are wrong."""
    stopping: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stopping.append(number))
    flags = record_flags(remove_ros_args(sys.argv)[1:])
    init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = RecordNode(flags)
    except (ValueError, OSError) as error:
        rclpy.try_shutdown()
        print(f"record: {error}", file=sys.stderr)
        sys.exit(2)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        print(f"recording to {node.config.output}", flush=True)
        spin_until(executor, lambda: bool(stopping), float("inf"))
        spin_until(executor, lambda: False, DRAIN_S)
    finally:
        node.recording.close()
        rclpy.try_shutdown()
    print(node.report(), flush=True)


if __name__ == "__main__":
    main()
