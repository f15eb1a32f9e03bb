"""The least a node can do: hear a typed RsuMeasurement, publish an Odometry. The yardstick of
latency."""

from __future__ import annotations

from typing import Any

import rclpy
from nav_msgs.msg import Odometry
from netpos_msgs.msg import RsuMeasurement
from netpos_node import BACKLOG, STREAM, run
from rclpy.node import Node

MEASUREMENTS = "/bench/measurements"
ODOMETRY = "/bench/odometry"


class RelayNode(Node):
    """Answers every measurement with an odometry of its stamp."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("bench_relay", **node_options)
        self._pub = self.create_publisher(Odometry, ODOMETRY, STREAM)
        self.create_subscription(RsuMeasurement, MEASUREMENTS, self._on_measurement, BACKLOG)

    def _on_measurement(self, msg: Any) -> None:
        self._pub.publish(Odometry(header=msg.header, child_frame_id=msg.vue_id))


def main() -> None:
    """Entry point of ``ros2 run netpos_bringup bench_relay``."""
    run(RelayNode, rclpy.spin)
