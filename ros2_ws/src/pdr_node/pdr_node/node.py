"""Dead-reckoning node: IMU and magnetometer in, steps and step velocities out."""

from __future__ import annotations

import sys
from collections.abc import Callable
from operator import itemgetter
from typing import Any

from geometry_msgs.msg import TwistWithCovarianceStamped
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.messages import topics
from netpos.messages.fields import stamp_ns
from netpos_msgs.msg import Step
from netpos_node import (
    BACKLOG,
    CODEC,
    STREAM,
    run,
    see_delivered,
    take_waiting,
    wait_until_heard,
)
from rclpy.node import Node
from sensor_msgs.msg import Imu, MagneticField

from pdr_node.conversions import messages
from pdr_node.parameters import declare_parameters

_PATIENCE_S = 30.0


class PdrNode(Node):
    """Feeds a ``PedestrianDeadReckoning`` core."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("pdr_node", **node_options)
        parameters = declare_parameters(self)
        self._vue_id = vue = parameters.vue_id
        self._core = PedestrianDeadReckoning(parameters.config)

        def topic(name: str) -> str:
            return topics.to_resolve(topics.of_vue(vue, name))

        self._step_pub = self.create_publisher(Step, topic(topics.STEP), STREAM)
        self._velocity_pub = self.create_publisher(
            TwistWithCovarianceStamped, topic(topics.STEP_VELOCITY), STREAM
        )
        self._wait_for_subscribers(parameters.subscribers)
        self._imu_sub = self.create_subscription(Imu, topic(topics.IMU), self._on_imu, BACKLOG)
        self._mag_sub = self.create_subscription(
            MagneticField, topic(topics.MAG), self._on_magnetic_field, BACKLOG
        )

    def _wait_for_subscribers(self, wanted: int) -> None:
        """Hear no sample before the steps are heard: who waits for imu's listeners loses none."""
        publishers = {p.topic_name: p for p in (self._velocity_pub, self._step_pub)}
        required = dict(zip(publishers, (wanted, max(wanted - 1, 0)), strict=True))
        unheard = wait_until_heard(publishers, required, _PATIENCE_S, settle_s=0.0)
        if unheard:
            self.get_logger().warning(
                f"too few subscribers to {', '.join(unheard)}; going on all the same"
            )

    def _on_imu(self, msg: Any) -> None:
        imu = CODEC.imu_from_msg(msg)
        output = self._core.add_imu(imu.stamp_ns, imu.angular_velocity, imu.specific_force)
        for notice in self._core.take_notices():
            self.get_logger().warning(notice)
        for is_step, message in messages(self._vue_id, output):
            (self._step_pub if is_step else self._velocity_pub).publish(message)

    def _on_magnetic_field(self, msg: Any) -> None:
        sample = CODEC.magnetic_field_from_msg(msg)
        self._core.add_magnetic_field(sample.stamp_ns, sample.magnetic_field)

    def finish(self) -> None:
        """Give out what still follows from all that has arrived, and see it delivered."""
        waiting: list[tuple[int, Callable[[Any], None], Any]] = []
        for sub, handler in (
            (self._mag_sub, self._on_magnetic_field),
            (self._imu_sub, self._on_imu),
        ):
            taken: list[Any] = []
            take_waiting(sub, taken.append)
            waiting += [(stamp_ns(msg.header.stamp), handler, msg) for msg in taken]
        for _, handler, msg in sorted(waiting, key=itemgetter(0)):
            handler(msg)
        see_delivered(self)


def main() -> None:
    """Entry point of ``ros2 run pdr_node pdr_node``."""
    run(PdrNode, arguments=sys.argv[1:])
