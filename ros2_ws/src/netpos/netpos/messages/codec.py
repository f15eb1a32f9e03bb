"""Values to messages and back, for any message classes with the fields of the ROS interfaces."""

from __future__ import annotations

from typing import Any

import numpy as np

from netpos.messages.common_codec import CommonCodec
from netpos.messages.fields import (
    MAP_FRAME,
    base_link,
    certain_stamp_ns,
    flat,
    lever_arm,
    square,
    stamp_ns,
    vue_of_frame,
    xyz,
)
from netpos.messages.values import (
    AngleConvention,
    Beacon,
    ClockState,
    Field,
    RsuErrors,
    RsuInfo,
    RsuMeasurement,
    Step,
    StepCalibration,
    TrackMode,
    TrackState,
    TrackStatus,
)


def _time_difference(msg: Any) -> dict[str, Any]:
    """The TDOA of a RsuMeasurement; nothing in recordings older than this field."""
    if not hasattr(msg, "tdoa"):
        return {}
    return {
        "tdoa_s": float(msg.tdoa),
        "tdoa_var": float(msg.tdoa_var),
        "reference_rsu_id": msg.reference_rsu_id,
    }


class Codec(CommonCodec):
    """Builds and reads all messages of netpos: netpos_msgs and those of common_interfaces."""

    def beacon_to_msg(self, beacon: Beacon) -> Any:
        """netpos_msgs/Beacon."""
        return self._resolve("netpos_msgs/msg/Beacon")(
            header=self.header(beacon.stamp_ns, MAP_FRAME),
            vue_id=beacon.vue_id,
            sequence=beacon.sequence,
            position=self._to_point(beacon.position),
            clock_offset=float(beacon.clock_offset_s),
        )

    @staticmethod
    def beacon_from_msg(msg: Any) -> Beacon:
        """Beacon value of a netpos_msgs/Beacon."""
        return Beacon(
            stamp_ns=certain_stamp_ns(msg.header.stamp),
            vue_id=msg.vue_id,
            sequence=int(msg.sequence),
            position=xyz(msg.position),
            clock_offset_s=float(msg.clock_offset),
        )

    def rsu_info_to_msg(self, info: RsuInfo) -> Any:
        """netpos_msgs/RsuInfo."""
        return self._resolve("netpos_msgs/msg/RsuInfo")(
            header=self.header(info.stamp_ns, MAP_FRAME),
            rsu_id=info.rsu_id,
            network=info.network,
            pose=self._to_pose(info.position, info.quaternion),
            azimuth_bias_sd=float(info.azimuth_bias_sd_rad),
            elevation_bias_sd=float(info.elevation_bias_sd_rad),
            range_bias_sd=float(info.range_bias_sd_m),
            bias_correlation_time=float(info.bias_correlation_time_s),
            common_range_bias_sd=float(info.common_range_bias_sd_m),
            common_bias_correlation_time=float(info.common_bias_correlation_time_s),
            noise_correlation_time=float(info.noise_correlation_time_s),
            angle_convention=int(info.angle_convention),
            baseline=float(info.baseline_m),
            wavelength=float(info.wavelength_m),
        )

    @staticmethod
    def rsu_info_from_msg(msg: Any) -> RsuInfo:
        """RsuInfo value of a netpos_msgs/RsuInfo."""
        q = msg.pose.orientation
        return RsuInfo(
            stamp_ns=stamp_ns(msg.header.stamp),
            rsu_id=msg.rsu_id,
            network=msg.network,
            frame_id=msg.header.frame_id,
            position=xyz(msg.pose.position),
            quaternion=np.array([q.x, q.y, q.z, q.w], dtype=np.float64),
            azimuth_bias_sd_rad=float(msg.azimuth_bias_sd),
            elevation_bias_sd_rad=float(msg.elevation_bias_sd),
            range_bias_sd_m=float(msg.range_bias_sd),
            bias_correlation_time_s=float(msg.bias_correlation_time),
            common_range_bias_sd_m=float(msg.common_range_bias_sd),
            common_bias_correlation_time_s=float(msg.common_bias_correlation_time),
            noise_correlation_time_s=float(msg.noise_correlation_time),
            angle_convention=AngleConvention(int(msg.angle_convention)),
            baseline_m=float(msg.baseline),
            wavelength_m=float(msg.wavelength),
        )

    def measurement_to_msg(self, m: RsuMeasurement) -> Any:
        """netpos_msgs/RsuMeasurement."""
        return self._resolve("netpos_msgs/msg/RsuMeasurement")(
            header=self.header(m.stamp_ns, MAP_FRAME),
            rsu_id=m.rsu_id,
            vue_id=m.vue_id,
            reference_rsu_id=m.reference_rsu_id,
            sequence=m.sequence,
            expected=m.expected,
            fields=int(m.fields),
            line_of_sight=bool(m.line_of_sight),
            rssi=float(m.rssi_dbm),
            azimuth=float(m.azimuth_rad),
            azimuth_var=float(m.azimuth_var),
            elevation=float(m.elevation_rad),
            elevation_var=float(m.elevation_var),
            toa=float(m.toa_s),
            toa_var=float(m.toa_var),
            range=float(m.range_m),
            range_var=float(m.range_var),
            phase_difference=float(m.phase_difference_rad),
            phase_difference_var=float(m.phase_difference_var),
            tdoa=float(m.tdoa_s),
            tdoa_var=float(m.tdoa_var),
            lever_arm=self._to_vector(m.lever_arm),
            position=self._to_point(m.position),
            position_covariance=flat(m.position_cov),
        )

    @staticmethod
    def measurement_from_msg(msg: Any) -> RsuMeasurement:
        """RsuMeasurement value of a netpos_msgs/RsuMeasurement; values are not judged here."""
        return RsuMeasurement(
            stamp_ns=stamp_ns(msg.header.stamp),
            frame_id=msg.header.frame_id,
            rsu_id=msg.rsu_id,
            vue_id=msg.vue_id,
            sequence=int(msg.sequence),
            expected=int(msg.expected),
            fields=Field(int(msg.fields)),
            line_of_sight=bool(msg.line_of_sight),
            rssi_dbm=float(msg.rssi),
            azimuth_rad=float(msg.azimuth),
            azimuth_var=float(msg.azimuth_var),
            elevation_rad=float(msg.elevation),
            elevation_var=float(msg.elevation_var),
            toa_s=float(msg.toa),
            toa_var=float(msg.toa_var),
            range_m=float(msg.range),
            range_var=float(msg.range_var),
            phase_difference_rad=float(msg.phase_difference),
            phase_difference_var=float(msg.phase_difference_var),
            **_time_difference(msg),
            lever_arm=lever_arm(msg),
            position=xyz(msg.position),
            position_cov=square(msg.position_covariance, 3),
        )

    def clock_state_to_msg(self, clock: ClockState) -> Any:
        """netpos_msgs/ClockState."""
        return self._resolve("netpos_msgs/msg/ClockState")(
            header=self.header(clock.stamp_ns, base_link(clock.vue_id)),
            offset=float(clock.offset_s),
            drift=float(clock.drift),
            covariance=flat(clock.cov),
        )

    @staticmethod
    def clock_state_from_msg(msg: Any) -> ClockState:
        """ClockState value of a netpos_msgs/ClockState."""
        return ClockState(
            stamp_ns=certain_stamp_ns(msg.header.stamp),
            vue_id=vue_of_frame(msg.header.frame_id),
            offset_s=float(msg.offset),
            drift=float(msg.drift),
            cov=square(msg.covariance, 2),
        )

    def track_status_to_msg(self, status: TrackStatus) -> Any:
        """netpos_msgs/TrackStatus."""
        reasons = sorted(status.rejected)
        return self._resolve("netpos_msgs/msg/TrackStatus")(
            header=self.header(status.stamp_ns, base_link(status.vue_id)),
            state=int(status.state),
            nis=float(status.nis),
            nis_dof=int(status.nis_dof),
            used=int(status.used),
            accepted=int(status.accepted),
            rejected=sum(status.rejected.values()),
            rejection_reasons=reasons,
            rejection_counts=np.array([status.rejected[r] for r in reasons], dtype=np.uint64),
            sources=list(status.sources),
            position_sd=float(status.position_sd_m),
            protection_level=float(status.protection_level_m),
            step_length_factor=float(status.steps.length_factor),
            step_length_factor_sd=float(status.steps.length_factor_sd),
            step_heading_offset=float(status.steps.heading_offset_rad),
            step_heading_offset_sd=float(status.steps.heading_offset_sd_rad),
            mode_weights=np.array([mode.weight for mode in status.modes], dtype=np.float64),
            mode_x=np.array([mode.x_m for mode in status.modes], dtype=np.float64),
            mode_y=np.array([mode.y_m for mode in status.modes], dtype=np.float64),
            reason=status.reason,
        )

    @staticmethod
    def track_status_from_msg(msg: Any) -> TrackStatus:
        """TrackStatus value of a netpos_msgs/TrackStatus."""
        counts = [int(n) for n in msg.rejection_counts]
        return TrackStatus(
            stamp_ns=certain_stamp_ns(msg.header.stamp),
            vue_id=vue_of_frame(msg.header.frame_id),
            state=TrackState(int(msg.state)),
            nis=float(msg.nis),
            nis_dof=int(msg.nis_dof),
            used=int(msg.used),
            accepted=int(msg.accepted),
            rejected=dict(zip(msg.rejection_reasons, counts, strict=True)),
            sources=tuple(msg.sources),
            position_sd_m=float(msg.position_sd),
            protection_level_m=float(msg.protection_level),
            steps=_step_calibration(msg),
            modes=_modes(msg),
            reason=getattr(msg, "reason", ""),  # recordings may be older than that
        )

    def rsu_errors_to_msg(self, errors: RsuErrors) -> Any:
        """netpos_msgs/RsuErrors."""

        def column(values: tuple[float, ...]) -> Any:
            return np.array(values, dtype=np.float64)

        return self._resolve("netpos_msgs/msg/RsuErrors")(
            header=self.header(errors.stamp_ns, base_link(errors.vue_id)),
            rsu_id=errors.rsu_id,
            quantities=list(errors.quantities),
            scatter=column(errors.scatter),
            bias=column(errors.bias),
            bias_sd=column(errors.bias_sd),
            bias_spread=column(errors.bias_spread),
            correlation_time=column(errors.correlation_time_s),
            stretch=column(errors.stretch),
            stretch_sd=column(errors.stretch_sd),
        )

    @staticmethod
    def rsu_errors_from_msg(msg: Any) -> RsuErrors:
        """RsuErrors value of a netpos_msgs/RsuErrors."""

        def column(values: Any) -> tuple[float, ...]:
            return tuple(float(value) for value in values)

        none = (0.0,) * len(msg.quantities)  # recordings may be older than the stretch
        return RsuErrors(
            stamp_ns=certain_stamp_ns(msg.header.stamp),
            rsu_id=str(msg.rsu_id),
            vue_id=vue_of_frame(msg.header.frame_id),
            quantities=tuple(msg.quantities),
            scatter=column(msg.scatter),
            bias=column(msg.bias),
            bias_sd=column(msg.bias_sd),
            bias_spread=column(msg.bias_spread),
            correlation_time_s=column(msg.correlation_time),
            stretch=column(getattr(msg, "stretch", none)),
            stretch_sd=column(getattr(msg, "stretch_sd", none)),
        )

    def step_to_msg(self, step: Step) -> Any:
        """netpos_msgs/Step."""
        return self._resolve("netpos_msgs/msg/Step")(
            header=self.header(step.stamp_ns, step.frame_id),
            start=self.time(step.start_ns),
            end=self.time(step.end_ns),
            count=step.count,
            length=float(step.length_m),
            length_var=float(step.length_var),
            heading=float(step.heading_rad),
            heading_var=float(step.heading_var),
            cadence=float(step.cadence_hz),
        )


def _modes(msg: Any) -> tuple[TrackMode, ...]:
    """Modes of a netpos_msgs/TrackStatus; older recordings have none."""
    if not hasattr(msg, "mode_weights"):
        return ()
    columns = (msg.mode_weights, msg.mode_x, msg.mode_y)
    return tuple(
        TrackMode(weight=float(w), x_m=float(x), y_m=float(y))
        for w, x, y in zip(*columns, strict=True)
    )


def _step_calibration(msg: Any) -> StepCalibration:
    """The step calibration of a netpos_msgs/TrackStatus; older recordings have none."""
    if not hasattr(msg, "step_length_factor"):
        return StepCalibration()
    return StepCalibration(
        length_factor=float(msg.step_length_factor),
        length_factor_sd=float(msg.step_length_factor_sd),
        heading_offset_rad=float(msg.step_heading_offset),
        heading_offset_sd_rad=float(msg.step_heading_offset_sd),
    )
