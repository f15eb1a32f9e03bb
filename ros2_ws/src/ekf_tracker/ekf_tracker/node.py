"""Tracker node: measurements in, odometry, clock state and health out."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from netpos.messages import topics
from netpos.messages.values import TrackStatus
from netpos.tracking import Tracker, TrackOutput
from netpos.tracking.warm_up import warm_up
from netpos_msgs.msg import ClockState, RsuInfo, RsuMeasurement
from netpos_msgs.msg import TrackStatus as TrackStatusMsg
from netpos_node import (
    BACKLOG,
    CDR,
    CODEC,
    LATCHED,
    STREAM,
    run,
    spin_until_stopped,
    wait_until_heard,
)
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from ekf_tracker.conversions import diagnostics_to_msg
from ekf_tracker.parameters import declare_parameters

_SILENCE_S = 2.0  # long: a stalled machine must not look like the end of the measurements
_DELIVERY_S = 1
_PATIENCE_S = 30.0


class EkfTrackerNode(Node):
    """Feeds a ``Tracker``.

    Measurements and estimates come and go as bytes. Whoever spins the node hands messages over in
    the order of their arrival, so that no topic overtakes another.
    """

    def __init__(self, **node_options: Any) -> None:
        warm_up()  # before the node is seen: whoever sees it may count on it
        super().__init__("ekf_tracker", **node_options)
        parameters = declare_parameters(self)
        self._tracker = Tracker(parameters.config)
        self._inputs: list[tuple[Subscription, Callable[[Any], None]]] = []
        self._outputs: dict[str, tuple[Publisher, ...]] = {}
        self._statuses: dict[str, TrackStatus] = {}
        self._heard_since_tick = False
        self._diagnostics_pub = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self._tf_pub = None
        if parameters.publish_tf:
            self._tf_pub = self.create_publisher(TFMessage, topics.TF, STREAM)
        self._listen(RsuInfo, topics.RSU_INFO, self._on_rsu_info, LATCHED)
        for vue_id in parameters.vue_ids:
            self._add_device(vue_id)
        self._wait_for_subscribers(parameters.subscribers)
        self._listen(RsuMeasurement, topics.RSU_MEASUREMENTS, self._on_measurement, raw=True)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/enable", self._on_enable)
        self.create_timer(_SILENCE_S, self._on_silence_tick)
        self.create_timer(1.0, self._publish_diagnostics)
        threshold = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
        )
        self._jump_handle = self.get_clock().create_jump_callback(
            threshold, post_callback=self._on_clock_jump
        )
        self.get_logger().info(f"tracking {', '.join(parameters.vue_ids)}")
        gc.collect()
        gc.freeze()  # what is here stays: looking at it again stalls a tracker of many devices

    def _wait_for_subscribers(self, wanted: int) -> None:
        """Hear no measurement before the estimates are heard: what is given out is then seen."""
        publishers = {pub.topic_name: pub for pubs in self._outputs.values() for pub in pubs}
        unheard = wait_until_heard(
            publishers, dict.fromkeys(publishers, wanted), _PATIENCE_S, settle_s=0.0
        )
        if unheard:
            self.get_logger().warning(
                f"fewer than {wanted} subscribers to {', '.join(unheard)}; tracking all the same"
            )

    # inputs

    def _listen(
        self,
        msg_type: Any,
        topic: str,
        handler: Callable[[Any], None],
        qos: Any = BACKLOG,
        *,
        raw: bool = False,
    ) -> None:
        def on_message(msg: Any) -> None:
            self._heard_since_tick = True
            handler(msg)
            self._publish(self._tracker.process())

        subscription = self.create_subscription(msg_type, topic, on_message, qos, raw=raw)
        self._inputs.append((subscription, on_message))

    @staticmethod
    def _take_waiting(subscription: Subscription, on_message: Callable[[Any], None]) -> None:
        kind = subscription.msg_type, subscription.raw
        with subscription.handle:
            while taken := subscription.handle.take_message(*kind):
                on_message(taken[0])

    def _on_rsu_info(self, msg: Any) -> None:
        try:
            self._tracker.add_rsu(CODEC.rsu_info_from_msg(msg))
        except ValueError as error:
            self.get_logger().error(str(error))

    def _on_measurement(self, cdr: bytes) -> None:
        self._take_waiting(*self._inputs[0])  # descriptions of RSUs come first
        measurement = CDR.measurement(cdr)
        if measurement is None:
            measurement = CODEC.measurement_from_msg(deserialize_message(cdr, RsuMeasurement))
        if measurement.vue_id not in self._outputs and topics.is_vue_id(measurement.vue_id):
            self._add_device(measurement.vue_id)
        self._add(measurement)

    def _add(self, item: Any) -> None:
        reason = self._tracker.add(item)
        if reason is not None:
            self.get_logger().warning(
                f"{item.vue_id}: refused a {type(item).__name__}: {reason}",
                throttle_duration_sec=2.0,
            )

    def _add_device(self, vue_id: str) -> None:
        def topic(name: str) -> str:
            return topics.of_vue(vue_id, name)

        outputs = [
            (Odometry, topics.ODOMETRY),
            (ClockState, topics.CLOCK_STATE),
            (TrackStatusMsg, topics.TRACK_STATUS),
        ]
        if self._tracker.config.fixed_lag_s > 0.0:
            outputs.append((Odometry, topics.ODOMETRY_SMOOTHED))
        self._outputs[vue_id] = tuple(
            self.create_publisher(kind, topic(name), STREAM) for kind, name in outputs
        )
        pose, twist = PoseWithCovarianceStamped, TwistWithCovarianceStamped
        self._listen(
            pose,
            topic(topics.INITIAL_POSE),
            lambda msg: self._add(CODEC.initial_pose_from_msg(msg, vue_id)),
        )
        self._listen(
            twist,
            topic(topics.STEP_VELOCITY),
            lambda msg: self._add(CODEC.velocity_from_msg(msg, vue_id)),
        )
        self._listen(
            twist,
            topic(topics.GROUND_SPEED),
            lambda msg: self._add(CODEC.ground_speed_from_msg(msg, vue_id)),
        )
        if self._tracker.config.use_imu:
            self._listen(Imu, topic(topics.IMU), lambda cdr: self._on_imu(cdr, vue_id), raw=True)

    def _on_imu(self, cdr: bytes, vue_id: str) -> None:
        sample = CDR.imu(cdr, vue_id)
        if sample is None:
            sample = CODEC.imu_from_msg(deserialize_message(cdr, Imu), vue_id)
        self._add(sample)

    # outputs

    def _publish(self, outputs: list[TrackOutput]) -> None:
        for output in outputs:
            self._statuses[output.status.vue_id] = output.status
            odometry_pub, clock_pub, status_pub, *smoothed_pub = self._outputs[
                output.status.vue_id
            ]
            if output.odometry is not None:
                odometry_pub.publish(CDR.odometry(output.odometry))
                if self._tf_pub is not None and not output.revised:
                    self._tf_pub.publish(CDR.transform(output.odometry))
            if output.clock is not None:
                clock_pub.publish(CDR.clock_state(output.clock))
            status_pub.publish(CDR.track_status(output.status))
            for odometry in output.smoothed:
                smoothed_pub[0].publish(CDR.odometry(odometry))

    def _publish_diagnostics(self) -> None:
        self._diagnostics_pub.publish(
            diagnostics_to_msg(
                self._statuses.values(), self._tracker.rsu_count, self._tracker.rsu_reports()
            )
        )

    def finish(self) -> None:
        """Give out what still follows from all that has arrived, and see it delivered."""
        for waiting in self._inputs:
            self._take_waiting(*waiting)
        self._publish(self._tracker.flush())
        for publisher in self.publishers:
            publisher.wait_for_all_acked(Duration(seconds=_DELIVERY_S))

    # time and services

    def _on_silence_tick(self) -> None:
        if not self._heard_since_tick:
            self._publish(self._tracker.flush())
        self._heard_since_tick = False

    def _on_clock_jump(self, jump: TimeJump) -> None:
        self.get_logger().warning("the clock jumped back: all tracks start anew")
        self._tracker.reset()

    def _on_reset(self, _: Any, response: Any) -> Any:
        self._tracker.reset()
        response.success, response.message = True, "all tracks start anew"
        return response

    def _on_enable(self, request: Any, response: Any) -> Any:
        self._tracker.enabled = bool(request.data)
        response.success = True
        response.message = "enabled" if request.data else "disabled: measurements are refused"
        return response


def _spin(node: Node) -> None:
    assert isinstance(node, EkfTrackerNode)
    spin_until_stopped(node, node.finish)


def main() -> None:
    """Entry point of ``ros2 run ekf_tracker ekf_tracker``."""
    run(EkfTrackerNode, _spin)
