"""Record the topics of a running graph: ``ros2 run netpos_bag record --output DIR``.

The recorder asks its subscriptions in turn for what has arrived: an executor looks at every topic
for each message, which of some hundred topics costs more than the messages.
"""

from __future__ import annotations

import signal
import sys
import time
from functools import partial
from operator import itemgetter
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from netpos import __version__
from netpos.bags import LOST_METADATA, BagError, BagWriter
from netpos.common.yaml_text import dump_yaml
from netpos.messages.topics import CLOCK, DIAGNOSTICS, RUN_TOPICS, below
from netpos_node import init, message_class, waiting
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.utilities import remove_ros_args

from netpos_bag.conversions import clock_ns, profile_to_bag, profile_to_record, unique
from netpos_bag.losses import Losses
from netpos_bag.parameters import RecordConfig, record_config, record_flags
from netpos_bag.recording import Recording
from netpos_bag.room import Level, Room

_TAKE_S = 0.01
_LOOK_S = 0.05
_FLUSH_S = 0.25
_DISK_S = 0.5
_WARN_S = 2.0
_DRAIN_S = 0.3  # after the signal to stop, what is on its way still arrives


class RecordNode(Node):
    """Subscribes to topics as they appear and writes what they bring."""

    def __init__(self, flags: dict[str, Any]) -> None:
        super().__init__("netpos_record", start_parameter_services=False)
        self.config: RecordConfig = record_config(self, flags)
        pairs = (item.partition("=") for item in self.config.metadata)
        run = {"netpos_version": __version__} | {key: value for key, _, value in pairs}
        parent = next(p for p in self.config.output.absolute().parents if p.exists())
        self.room = Room(parent, self.config.min_free_mb)
        if self.room.look(time.monotonic()) is Level.ERROR:
            raise ValueError(self.room.sentence)
        self.writer = BagWriter(self.config.output, metadata=run)
        self.recording = Recording(self.writer, self.config.log_time)
        self._topics: dict[str, _Topic] = {}
        self._left_out: set[str] = set()
        self._due_s = dict.fromkeys((self._look_for_topics, self._tick, self._look_at_disk), 0.0)
        self._diagnostics: Publisher | None = None

    def run(self, stopping: list[int], seconds: float = float("inf")) -> None:
        """Record until ``stopping`` holds a signal or the disk is full, at most ``seconds``."""
        end_s = time.monotonic() + seconds
        periods_s = (_LOOK_S, _FLUSH_S, _DISK_S)
        while not stopping and not self.full and (now_s := time.monotonic()) < end_s:
            for task, period_s in zip(self._due_s, periods_s, strict=True):
                if now_s >= self._due_s[task]:
                    self._due_s[task] = now_s + period_s
                    task()
            self._take()
            time.sleep(_TAKE_S)

    def _look_for_topics(self) -> None:
        for name, types in self.get_topic_names_and_types():
            publishers = self.count_publishers(name)
            known = self._topics.get(name)
            if known is None and publishers and name not in self._left_out:
                self._subscribe(name, types)
            elif known is not None and publishers > known.publishers:
                self._check_publishers(known)

    def _subscribe(self, name: str, types: list[str]) -> None:
        written = below(name, self.get_namespace())
        if not written:
            self._left_out.add(name)
            return
        wanted = not self.config.topics or written in (*self.config.topics, *RUN_TOPICS)
        if not wanted and name != CLOCK:
            return
        if len(types) > 1:
            self._leave_out(name, f"it has several types: {', '.join(types)}")
            return
        offered = [info.qos_profile for info in self.get_publishers_info_by_topic(name)]
        noted = unique(map(profile_to_bag, offered))
        try:
            kind = message_class(types[0])
            if wanted:
                self.writer.add_topic(written, types[0], noted)
        except (BagError, ImportError, AttributeError) as error:
            self._leave_out(name, str(error))
            return
        profile = profile_to_record(noted)
        subscription = self.create_subscription(kind, name, lambda _: None, profile, raw=True)
        losses = Losses(partial(self.count_publishers, name))
        self._topics[name] = _Topic(
            name, types[0] if wanted else "", subscription, profile, losses, len(offered), written
        )

    def _leave_out(self, name: str, reason: str) -> None:
        self._left_out.add(name)
        self.get_logger().warning(f"{name} is not recorded: {reason}")

    def _check_publishers(self, topic: _Topic) -> None:
        """Tell of publishers that offer less than what was asked of the first ones."""
        infos = self.get_publishers_info_by_topic(topic.name)
        topic.publishers = len(infos)
        for info in infos:
            fits, reason = qos_check_compatible(info.qos_profile, topic.profile)
            if fits == QoSCompatibility.ERROR:
                self.get_logger().warning(
                    f"{topic.name}: {info.node_name} is not recorded: it offers less than the "
                    f"first publisher did ({reason})"
                )

    def _take(self) -> None:
        """Write what has arrived, in the order of arrival."""
        arrived = [
            (told["received_timestamp"], topic, cdr, told["publication_sequence_number"])
            for topic in self._topics.values()
            for cdr, told in waiting(topic.subscription)
        ]
        wall_ns = time.time_ns()
        for _, topic, cdr, number in sorted(arrived, key=itemgetter(0)):
            if topic.losses.arrived(number):
                self.get_logger().warning(
                    f"{topic.name}: {topic.losses.count} messages lost",
                    throttle_duration_sec=_WARN_S,
                )
            if topic.name == CLOCK:
                self.recording.clock(clock_ns(cdr))
            if topic.type_name:
                self.recording.message(topic.written, topic.type_name, cdr, wall_ns)

    def _tick(self) -> None:
        jumps = self.recording.backward_jumps
        self.recording.tick(time.time_ns(), self.count_publishers(CLOCK) > 0)
        if jumps:
            self.get_logger().warning(
                f"/clock went back {jumps} times; the bag mixes what came before and after",
                throttle_duration_sec=10.0,
            )

    @property
    def full(self) -> bool:
        """Whether so little room is left that the recording has to end."""
        return self.room.level is Level.ERROR

    def _look_at_disk(self) -> None:
        """Warn before the disk is full, in the log and on /diagnostics."""
        before = self.room.level
        level = self.room.look(time.monotonic())
        if level is Level.OK and before is Level.OK:
            return
        if level is not Level.OK:
            self.get_logger().warning(self.room.sentence, throttle_duration_sec=10.0)
        if self._diagnostics is None:
            self._diagnostics = self.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        said = DiagnosticArray()
        said.header.stamp = self.get_clock().now().to_msg()
        said.status.append(
            DiagnosticStatus(
                level=bytes([level]),
                name="netpos_record: disk",
                message=self.room.sentence or "room again",
                hardware_id=str(self.config.output),
            )
        )
        self._diagnostics.publish(said)

    @property
    def lost(self) -> dict[str, int]:
        """Messages that were published and did not arrive, by topic."""
        topics = sorted(self._topics.values(), key=lambda topic: topic.name)
        return {topic.name: topic.losses.count for topic in topics if topic.losses.count}

    def close(self) -> None:
        """Note what was lost, and finish the bag, unless it could not be written any more."""
        if self.writer.closed:
            return
        self.writer.note(LOST_METADATA, dump_yaml(self.lost))
        self.recording.close()

    def report(self) -> str:
        """Counts per topic, and what was lost."""
        counts = self.writer.counts
        lines = [f"{self.config.output}: {sum(counts.values())} messages"]
        lines += [f"  {topic}: {count}" for topic, count in sorted(counts.items())]
        missing = sorted(set(self.config.topics) - counts.keys())
        lines += [f"  MISSING {topic}: nothing was published" for topic in missing]
        lines += [f"  LOST {topic}: {count}" for topic, count in self.lost.items()]
        return "\n".join(lines)


class _Topic:
    """A topic that is listened to; ``type_name`` is empty where it is not recorded."""

    __slots__ = (
        "losses",
        "name",
        "profile",
        "publishers",
        "subscription",
        "type_name",
        "written",
    )

    def __init__(
        self,
        name: str,
        type_name: str,
        subscription: Subscription,
        profile: QoSProfile,
        losses: Losses,
        publishers: int,
        written: str,
    ) -> None:
        self.name, self.written = name, written
        self.type_name = type_name
        self.subscription = subscription
        self.profile = profile
        self.losses = losses
        self.publishers = publishers


def main() -> None:
    """Record until SIGINT or SIGTERM; exit 0, 1 where the disk is full, 2 where the options are
    wrong."""
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
    try:
        print(f"recording to {node.config.output}", flush=True)
        try:
            node.run(stopping)
            node.run([], _DRAIN_S)
        finally:
            node.close()
    except OSError as error:
        sys.exit(
            f"record: {error.filename or node.config.output}: {error.strerror or error}; the "
            f"recording ended. Make room, then: netpos recover {node.config.output}"
        )
    finally:
        rclpy.try_shutdown()
    print(node.report(), flush=True)
    if node.full:
        sys.exit(f"record: the recording ended and is whole: {node.room.sentence}")


if __name__ == "__main__":
    main()
