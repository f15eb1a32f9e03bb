"""Play a bag into the running graph: ``ros2 run netpos_bag play BAG``."""

from __future__ import annotations

import signal
import sys
import time
from typing import Any

import rclpy
from netpos.bags import BagEntry, BagReader
from netpos.messages.topics import CLOCK, RUN_SCENARIO
from netpos.scenario.settings import FUSION_FACT, TRACKER_FACT
from netpos_node import init, message_class, say_of_run, wait_until_heard
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from netpos_bag.conversions import clock_cdr, profile_to_play
from netpos_bag.parameters import PlayConfig, play_config, play_flags
from netpos_bag.playback import Plan

_NOT_OF_THE_INPUT = (TRACKER_FACT, FUSION_FACT, "netpos_version")
ACK_S = 5.0  # Fast DDS asks its readers every 3 s
CATCH_UP_S = 60.0  # what a subscriber has that is behind at the end
LINGER_S = 0.5  # latched messages stay available for so long after the end


class PlayNode(Node):
    """Publishes a bag in log order from one thread."""

    def __init__(self, flags: dict[str, Any]) -> None:
        super().__init__("netpos_play")
        self.config: PlayConfig = play_config(self, flags)
        self.bag = BagReader(self.config.bag)
        self.plan = Plan.make(self.bag, self.config)
        self.outlets = {topic: self._outlet(topic) for topic in self.plan.topics}
        self.counts = dict.fromkeys(self.outlets, 0)
        if RUN_SCENARIO not in self.bag.topics:
            noted = {k: v for k, v in self.bag.metadata.items() if k not in _NOT_OF_THE_INPUT}
            say_of_run(self, RUN_SCENARIO, noted)
        clock_class = message_class("rosgraph_msgs/msg/Clock")
        self._ticker = self.create_publisher(clock_class, CLOCK, 10)
        self.max_lag_s = 0.0
        self._latched = {
            topic
            for topic in self.outlets
            if profile_to_play(self.bag.topics[topic].qos).durability
            is DurabilityPolicy.TRANSIENT_LOCAL
        }
        self._latched_pending: set[str] = set()

    def _outlet(self, topic: str) -> Publisher:
        info = self.bag.topics[topic]
        profile = profile_to_play(info.qos)
        return self.create_publisher(message_class(info.type_name), topic, profile)

    def _publish(self, entry: BagEntry) -> None:
        self.outlets[entry.topic].publish(entry.cdr)
        self.counts[entry.topic] += 1

    def wait_for_subscribers(self) -> None:
        """Wait for the named topics to have a subscriber, then for the graph to be at rest."""
        named = {
            topic: self.config.subscribers
            for topic in self.config.wait_for_subscribers
            if topic in self.outlets
        }
        missing = wait_until_heard(self.outlets, named, self.config.wait_timeout)
        if missing:
            self.get_logger().warning(
                f"too few subscribers to {', '.join(missing)} after {self.config.wait_timeout} s; "
                "playing all the same"
            )

    def play(self) -> None:
        """Once from the start to the end."""
        self._ticker.publish(clock_cdr(self.plan.start_ns))
        for entry in self.plan.leading():
            self._latched_pending.add(entry.topic)
            self._publish(entry)
        self.wait_for_subscribers()
        begin = time.monotonic()
        for log_time_ns, entry in self.plan.events():
            due = begin + (log_time_ns - self.plan.start_ns) / 1e9 / self.config.rate
            late = time.monotonic() - due
            if late < 0:
                time.sleep(-late)
            else:
                self.max_lag_s = max(self.max_lag_s, late)
            if entry is None:
                self._ticker.publish(clock_cdr(log_time_ns))
            else:
                begin += self._see_descriptions_arrive(entry.topic)
                self._publish(entry)

    def _see_descriptions_arrive(self, next_topic: str) -> float:
        """Before a topic that is not latched goes on: what was latched has arrived, so that no
        measurement overtakes the description of its RSU. Returns the seconds waited."""
        if self._latched_pending and next_topic not in self._latched:
            start = time.monotonic()
            for topic in self._latched_pending:
                self.outlets[topic].wait_for_all_acked(Duration(seconds=ACK_S))
            self._latched_pending.clear()
            return time.monotonic() - start
        if next_topic in self._latched:
            self._latched_pending.add(next_topic)
        return 0.0

    def finish(self) -> None:
        """Leave when all is acknowledged, which a tracker that is behind may take a while for."""
        end = time.monotonic() + CATCH_UP_S
        asks = Duration(seconds=0.5)  # a signal is heard in between
        for topic, outlet in self.outlets.items():
            while not outlet.wait_for_all_acked(asks):
                if time.monotonic() > end:
                    self.get_logger().warning(f"{topic}: a subscriber did not acknowledge all")
                    break
        time.sleep(LINGER_S)

    def report(self) -> str:
        """Counts per topic and the worst lag."""
        total = sum(self.counts.values())
        lines = [
            f"{self.config.bag}: {total} messages published, at most {self.max_lag_s:.3f} s late"
        ]
        return "\n".join(lines + [f"  {topic}: {count}" for topic, count in self.counts.items()])


def main() -> None:
    """Play to the end (or until SIGINT, SIGTERM); exit 0, or 2 where options or bag are wrong."""
    flags = play_flags(remove_ros_args(sys.argv)[1:])
    init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = PlayNode(flags)
    except (ValueError, OSError) as error:
        rclpy.try_shutdown()
        print(f"play: {error}", file=sys.stderr)
        sys.exit(2)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        node.play()
        while node.config.loop:
            node.play()
        node.finish()
    except KeyboardInterrupt:
        pass
    finally:
        print(node.report(), flush=True)
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
