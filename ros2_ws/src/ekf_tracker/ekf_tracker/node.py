"""Tracker node: measurements in, odometry, clock state and health out."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from netpos.messages import topics
from netpos.messages.values import RsuMeasurement as Measurement
from netpos.scenario.settings import change_fact, tracker_fact
from netpos.tracking import Tracker, TrackOutput
from netpos.tracking.door.validation import explanation
from netpos.tracking.warm_up import warm_up, warm_up_anchors
from netpos.world.geodesy import Datum
from netpos_msgs.msg import NetworkTrack, RsuErrors, RsuInfo, RsuMeasurement
from netpos_node import (
    BACKLOG,
    CDR,
    CODEC,
    LATCHED,
    patience,
    run,
    say_of_run,
    take_waiting,
)
from netpos_node.estimating import EstimatingNode
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from ekf_tracker.conversions import diagnostics_to_msg, network_track_to_msg
from ekf_tracker.parameters import Parameters

_COPY_S = 2.0
_TELL_S = 2.0  # a word in the log about what is refused
_TOPICS_EVERY_S = (
    0.25  # between the topics of two devices: to make them stops the others for 60 ms
)


class EkfTrackerNode(EstimatingNode):
    """Feeds a ``Tracker``. Measurements and estimates come and go as bytes."""

    def __init__(self, **node_options: Any) -> None:
        with patience("compiling the kernels, some minutes, once after a change of the sources"):
            warm_up("")  # before the node is seen: whoever sees it may count on it
        super().__init__("ekf_tracker", **node_options)
        self._heard_of: set[str] = set()  # devices that are listened to
        self._chosen = Parameters(self)
        self._tracker: Tracker | None = None
        self._chosen.watch(lambda: self._tracker, self._say_change)
        self._start_up()

    def _configure(self) -> None:
        parameters = self._chosen.read()
        config = parameters.config
        if config.network:
            warm_up(config.network)
        tracker = Tracker(config, parameters.rsu_list)
        self._network = config.network
        self._told_refusal_s = -_TELL_S
        self._topics_made_s = -_TOPICS_EVERY_S
        self._poses: dict[str, tuple[Any, float]] = {}
        datum = Datum(*config.datum_values) if config.datum_values is not None else None
        self._begin(tracker, publish_tf=parameters.publish_tf, frames=config.frames, datum=datum)
        self._tracker = tracker
        self._diagnostics_pub = self._offer(DiagnosticArray, topics.DIAGNOSTICS)
        self._errors_pub = self._track_pub = self._run_pub = None
        if config.learn_errors:
            self._errors_pub = self._offer(RsuErrors, topics.RSU_LEARNED)
        if self._network:
            self._track_pub = self._offer(NetworkTrack, topics.tracks_of(self._network))
        self._offers.append(self.create_service(Trigger, "~/accept_rsus", self._on_accept_rsus))
        self._kept = frozenset(parameters.vue_ids)
        for vue_id in parameters.vue_ids:
            self._add_device(vue_id)

    def _activate(self) -> None:
        parameters = self._chosen.read()
        self._listen(RsuInfo, topics.RSU_INFO, self._on_rsu_info, LATCHED)
        for vue_id in self._outputs:
            self._listen_to(vue_id)
        extra = [self._track_pub] if self._track_pub is not None else []
        self._wait_for_subscribers(parameters.subscribers, extra)
        self._listen(RsuMeasurement, topics.RSU_MEASUREMENTS, self._on_measurement, raw=True)
        if self._run_pub is None:
            facts = tracker_fact(self.tracker.config, parameters.settings.rsus)
            self._run_pub = say_of_run(self, topics.RUN_ESTIMATOR, facts)
            self._offers.append(self._run_pub)
        self._be_ready()
        self.get_logger().info(f"tracking {', '.join(parameters.vue_ids)}")

    def _clean_up(self) -> None:
        super()._clean_up()
        self._tracker = self._run_pub = None

    @property
    def tracker(self) -> Tracker:
        """The core, of a node that is configured."""
        assert self._tracker is not None
        return self._tracker

    def _say_change(self, names: Sequence[str]) -> None:
        """Note in recordings that parameters changed while the tracker ran."""
        values = {name: getattr(self.tracker.config, name) for name in names}
        told = ", ".join(f"{name} is now {value!r}" for name, value in values.items())
        self.get_logger().info(told)
        if self._run_pub is not None:
            stamps = [status.stamp_ns for status in self._statuses.values()]
            fact = change_fact(max(stamps, default=0), values)
            for key, value in fact.items():
                self._run_pub.publish(KeyValue(key=key, value=value))

    def _on_accept_rsus(self, _: Any, response: Any) -> Any:
        names = self.tracker.accept_rsus()
        response.success = bool(names)
        response.message = f"accepted: {', '.join(names)}" if names else "no RsuInfo is waiting"
        return response

    def _on_rsu_info(self, msg: Any) -> None:
        try:
            info = CODEC.rsu_info_from_msg(msg)
            self.tracker.add_rsu(info)
        except ValueError as error:
            self.get_logger().error(str(error), throttle_duration_sec=2.0)
            return
        if info.baseline_m > 0.0:
            warm_up_anchors()

    def _on_measurement(self, cdr: bytes) -> None:
        source = CDR.source(cdr)
        if source is not None and self.tracker.floods(*source):
            return
        take_waiting(*self._inputs[0])  # descriptions of RSUs come first
        measurement = CDR.measurement(cdr)
        if measurement is None:
            message = self._read(cdr, RsuMeasurement)
            if message is None:
                return
            measurement = CODEC.measurement_from_msg(message)
        if not self.tracker.concerns(measurement):
            return
        refused = self._add(measurement)
        for vue_id in self.tracker.take_left():
            self._remove_device(vue_id)
        vue_id = measurement.vue_id
        if refused is None and vue_id not in self._heard_of and vue_id not in self._outputs:
            self._hear_candidate(vue_id)

    def _add(self, item: Any) -> str | None:
        """Hand it to the tracker; the reason where it is refused."""
        reason = self.tracker.add(item)
        if reason is not None and time.monotonic() - self._told_refusal_s >= _TELL_S:
            self._told_refusal_s = time.monotonic()
            source = ""
            if isinstance(item, Measurement):
                why = explanation(item, reason)
                source = f", from {item.rsu_id}" + (f": {why}" if why else "")
            self.get_logger().warning(
                f"{item.vue_id}: refused a {type(item).__name__}: {reason}{source}"
            )
        return reason

    def _has_time(self) -> bool:
        """Whether the topics of another new device may be made now."""
        now_s = time.monotonic()
        if now_s - self._topics_made_s < _TOPICS_EVERY_S:
            return False
        self._topics_made_s = now_s
        return True

    def _add_device(self, vue_id: str) -> None:
        """Offer the estimates of a device, and listen to it."""
        self._add_outputs(vue_id, self._network, smoothed=self.tracker.config.fixed_lag_s > 0.0)
        self._told_s.setdefault(vue_id, time.monotonic())
        self._seen_ns.setdefault(vue_id, (0, self.get_clock().now().nanoseconds))
        if self.is_active and vue_id not in self._heard_of:
            self._listen_to(vue_id)

    def _hear_candidate(self, vue_id: str) -> None:
        """Listen to a device that has no fix and needs one from outside."""
        if self.tracker.lacks_something(vue_id) and self._has_time():
            self._listen_to(vue_id)

    def _give_back(self, vue_id: str) -> None:
        super()._give_back(vue_id)
        self._heard_of.discard(vue_id)

    def _stop_listening(self) -> None:
        super()._stop_listening()
        self._heard_of.clear()

    def _listen_to(self, vue_id: str) -> None:
        self._heard_of.add(vue_id)

        def topic(name: str) -> str:
            return topics.of_vue(vue_id, name)

        pose, twist = PoseWithCovarianceStamped, TwistWithCovarianceStamped
        for qos in (BACKLOG, LATCHED):  # a tool's pose is not latched, one from before us is
            self._listen(
                pose, topic(topics.INITIAL_POSE), lambda msg: self._on_pose(msg, vue_id), qos
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
        if self.tracker.config.use_imu:
            self._listen(Imu, topic(topics.IMU), lambda cdr: self._on_imu(cdr, vue_id), raw=True)

    def _on_pose(self, msg: Any, vue_id: str) -> None:
        """A latched pose comes twice; its second copy says nothing new."""
        last, heard_s = self._poses.get(vue_id, (None, 0.0))
        now_s = time.monotonic()
        if msg == last and now_s - heard_s < _COPY_S:
            return
        self._poses[vue_id] = msg, now_s
        self._add(CODEC.initial_pose_from_msg(msg, vue_id))

    def _on_imu(self, cdr: bytes, vue_id: str) -> None:
        sample = CDR.imu(cdr, vue_id)
        if sample is None:
            message = self._read(cdr, Imu)
            if message is None:
                return
            sample = CODEC.imu_from_msg(message, vue_id)
        self._add(sample)

    def _publish_one(self, output: TrackOutput) -> None:
        vue_id = output.status.vue_id
        if vue_id not in self._outputs:
            if not self.tracker.has_fix(vue_id) or not self._has_time():
                self._note(output.status)
                return
            self._add_device(vue_id)
        super()._publish_one(output)
        if self._errors_pub is not None:
            for errors in output.errors:
                self._errors_pub.publish(CODEC.rsu_errors_to_msg(errors))
        if self._track_pub is not None and output.track is not None:
            self._track_pub.publish(network_track_to_msg(CODEC, output.track))

    def _publish_diagnostics(self) -> None:
        self._release_silent()
        silent_s = self._silent_s()
        known = silent_s.keys() & self._seen_ns.keys() & self._outputs.keys()
        for vue_id, stamp_ns in self._now_ns(known).items():
            coasting = self.tracker.coasting(vue_id, stamp_ns)
            if coasting is not None:
                self._publish_status(coasting.status)
        findings = self.tracker.findings(
            self._statuses, silent_s, self._unheard_s(), self._warnings()
        )
        newest_ns = max((status.stamp_ns for status in self._statuses.values()), default=0)
        self._diagnostics_pub.publish(diagnostics_to_msg(findings, newest_ns, self._subject()))

    def _release_silent(self) -> None:
        """Give back the topics of devices that are silent for so long that their track starts
        anew; of those of which nothing was ever taken nothing is told any more."""
        now_ns, limit_ns = self.get_clock().now().nanoseconds, 1e9 * self.tracker.config.max_gap_s
        silent = self._silent_s().keys() & self._seen_ns.keys() - self._kept
        over = [v for v in silent if now_ns - self._seen_ns[v][1] > limit_ns]
        taken = {v for v in over if v in self._statuses and self._statuses[v].accepted}
        due = [v for v in over if v not in taken or v in self._outputs or v in self._heard_of]
        for vue_id in due[: round(1.0 / _TOPICS_EVERY_S)]:
            if vue_id in taken:
                self._give_back(vue_id)
            else:
                self._remove_device(vue_id)

    def _subject(self) -> str:
        """Whose diagnostics they are: of which namespace, of which network."""
        space = self.get_namespace().strip("/")
        name = f"{space}/ekf_tracker" if space else "ekf_tracker"
        return f"{name} {self._network}".rstrip()

    def _warnings(self) -> list[str]:
        """What keeps the tracker from hearing anything, or from being heard as the only one."""
        found = self._input_warnings()
        if not self.tracker.enabled:
            return ["disabled: measurements are refused", *found]
        unheard_s = self._unheard_s()
        if unheard_s and self._statuses:
            found.insert(0, f"nothing heard for {unheard_s:.0f} s")
        return found


def main() -> None:
    """Entry point of ``ros2 run ekf_tracker ekf_tracker``."""
    run(EkfTrackerNode, arguments=sys.argv[1:])
