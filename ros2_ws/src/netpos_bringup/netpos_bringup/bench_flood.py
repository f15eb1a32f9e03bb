"""An RSU out of order: it repeats one measurement thousands of times a second, until it is
stopped."""

from __future__ import annotations

import sys
import time

from netpos.messages import topics
from netpos_msgs.msg import RsuMeasurement
from netpos_node import BACKLOG, run
from rclpy.node import Node

from netpos_bringup.bench_traffic import flooding

_SLEEP_S = 0.001


class FloodNode(Node):
    """Publishes ``rate_hz`` measurements a second; stamps are those of the time since it began."""

    def __init__(self) -> None:
        super().__init__("bench_flood", start_parameter_services=False)
        self._pub = self.create_publisher(RsuMeasurement, topics.RSU_MEASUREMENTS, BACKLOG)

    def send(self, rate_hz: float) -> None:
        """Send until the context ends."""
        begin, sent = time.perf_counter(), 0
        while self.context.ok():
            now_s = time.perf_counter() - begin
            message = flooding(now_s)
            for _ in range(round(rate_hz * now_s) - sent):
                self._pub.publish(message)
                sent += 1
            time.sleep(_SLEEP_S)


def main() -> None:
    """Send at the rate that is the first argument [messages/s]."""
    rate_hz = float(sys.argv[1])
    run(FloodNode, lambda node: node.send(rate_hz))
