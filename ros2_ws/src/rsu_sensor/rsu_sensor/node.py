"""RSU node: hears the beacons of a scenario's devices and publishes what its RSUs measure."""

from __future__ import annotations

import sys
from typing import Any

from netpos.messages.topics import BEACON, RSU_INFO, RSU_MEASUREMENTS, of_vue, to_resolve
from netpos_msgs.msg import Beacon, RsuInfo, RsuMeasurement
from netpos_node import LATCHED, STREAM, run, see_delivered, take_waiting, wait_until_heard
from rclpy.duration import Duration
from rclpy.node import Node

from rsu_sensor.conversions import beacon_from_msg, measurement_to_msg, rsu_info_to_msg
from rsu_sensor.parameters import declare_parameters

_PATIENCE_S = 30.0
_DELIVERY_S = 5


class RsuSensorNode(Node):
    """Hosts the RSUs of a scenario, or some of them."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("rsu_sensor", **node_options)
        self._settings = declare_parameters(self)
        self._settings.simulation.warm_up()
        self.refused = 0
        self._info_pub = self.create_publisher(RsuInfo, to_resolve(RSU_INFO), LATCHED)
        self._measurement_pub = self.create_publisher(
            RsuMeasurement, to_resolve(RSU_MEASUREMENTS), STREAM
        )
        for rsu in self._settings.simulation.rsus:
            if rsu.rsu_id in self._settings.rsu_ids:
                self._info_pub.publish(rsu_info_to_msg(rsu))
        self._wait_for_subscribers()
        self._beacon_subs = [
            self.create_subscription(
                Beacon, to_resolve(of_vue(vue_id, BEACON)), self._on_beacon, STREAM
            )
            for vue_id in self._settings.scenario.vue_ids
        ]
        self.get_logger().info(
            f"{self._settings.scenario.name}: {len(self._settings.rsu_ids)} RSUs listen to "
            f"{', '.join(self._settings.scenario.vue_ids)}"
        )

    def _wait_for_subscribers(self) -> None:
        wanted = {RSU_MEASUREMENTS: self._settings.subscribers}
        publishers = {RSU_MEASUREMENTS: self._measurement_pub}
        if wait_until_heard(publishers, wanted, _PATIENCE_S, settle_s=0.0):
            self.get_logger().warning(
                f"fewer than {self._settings.subscribers} subscribers to {RSU_MEASUREMENTS}; "
                "measuring all the same"
            )
        # no measurement overtakes the description of its RSU
        self._info_pub.wait_for_all_acked(Duration(seconds=_DELIVERY_S))

    def _on_beacon(self, msg: Any) -> None:
        try:
            measurements = self._settings.simulation.measure(beacon_from_msg(msg))
        except ValueError as error:
            self.refused += 1
            self.get_logger().warning(
                f"{self.refused} beacons refused: {error}", throttle_duration_sec=2.0
            )
            return
        for measurement in measurements:
            if measurement.rsu_id in self._settings.rsu_ids:
                self._measurement_pub.publish(measurement_to_msg(measurement))

    def finish(self) -> None:
        """Measure what beacons are waiting, and see it delivered."""
        for subscription in self._beacon_subs:
            take_waiting(subscription, self._on_beacon)
        see_delivered(self)


def main() -> None:
    """Entry point of ``ros2 run rsu_sensor rsu_sensor``."""
    run(RsuSensorNode, arguments=sys.argv[1:])
