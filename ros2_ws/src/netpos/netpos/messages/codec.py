"""Values to messages and back, for any message classes with the fields of the ROS interfaces.

``Codec(resolve)`` takes a function that returns the class of a type name such as
``"nav_msgs/msg/Odometry"``. Every message is built
with all fields by keyword, which both rclpy's and rosbags' classes accept.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from netpos.messages.fields import (
    MAP_FRAME,
    NS,
    base_link,
    embed,
    flat,
    imu_covariance,
    lever_arm,
    square,
    stamp_ns,
    vue_of_frame,
    xyz,
)
from netpos.messages.values import (
    AngleConvention,
    Array,
    Beacon,
    ClockState,
    Field,
    GroundSpeed,
    ImuSample,
    InitialPose,
    MagneticSample,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    Step,
    StepCalibration,
    TrackState,
    TrackStatus,
    Velocity,
)


class Codec:
    """Builds and reads the messages of netpos; ``resolve`` maps a type name to its class."""

    def __init__(self, resolve: Callable[[str], Any]) -> None:
        self._resolve = resolve
        self._time = resolve("builtin_interfaces/msg/Time")
        self._header = resolve("std_msgs/msg/Header")
        self._point = resolve("geometry_msgs/msg/Point")
        self._vector = resolve("geometry_msgs/msg/Vector3")
        self._quaternion = resolve("geometry_msgs/msg/Quaternion")
        self._pose = resolve("geometry_msgs/msg/Pose")

    def message_class(self, type_name: str) -> Any:
        """The class of a type name."""
        return self._resolve(type_name)

    def time(self, ns: int) -> Any:
        """builtin_interfaces/Time of integer nanoseconds."""
        sec, nanosec = divmod(int(ns), NS)
        return self._time(sec=sec, nanosec=nanosec)

    def header(self, ns: int, frame_id: str) -> Any:
        """std_msgs/Header."""
        return self._header(stamp=self.time(ns), frame_id=frame_id)

    def _to_point(self, v: Array) -> Any:
        return self._point(x=float(v[0]), y=float(v[1]), z=float(v[2]))

    def _to_vector(self, v: Array | tuple[float, float, float]) -> Any:
        return self._vector(x=float(v[0]), y=float(v[1]), z=float(v[2]))

    def _to_quaternion(self, q: Array) -> Any:
        return self._quaternion(x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3]))

    def _to_pose(self, position: Array, quaternion: Array) -> Any:
        return self._pose(
            position=self._to_point(position), orientation=self._to_quaternion(quaternion)
        )

    def clock_to_msg(self, ns: int) -> Any:
        """rosgraph_msgs/Clock."""
        return self._resolve("rosgraph_msgs/msg/Clock")(clock=self.time(ns))

    # netpos_msgs

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
            stamp_ns=stamp_ns(msg.header.stamp),
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
            lever_arm=self._to_vector(m.lever_arm),
            position=self._to_point(m.position),
            position_covariance=flat(m.position_cov),
        )

    @staticmethod
    def measurement_from_msg(msg: Any) -> RsuMeasurement:
        """RsuMeasurement value of a netpos_msgs/RsuMeasurement; values are not judged here."""
        return RsuMeasurement(
            stamp_ns=stamp_ns(msg.header.stamp),
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
            stamp_ns=stamp_ns(msg.header.stamp),
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
        )

    @staticmethod
    def track_status_from_msg(msg: Any) -> TrackStatus:
        """TrackStatus value of a netpos_msgs/TrackStatus."""
        counts = [int(n) for n in msg.rejection_counts]
        return TrackStatus(
            stamp_ns=stamp_ns(msg.header.stamp),
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

    # common_interfaces

    def odometry_to_msg(self, odometry: Odometry) -> Any:
        """nav_msgs/Odometry: pose in map, twist in the device's base_link."""
        twist = self._resolve("geometry_msgs/msg/Twist")(
            linear=self._to_vector(odometry.linear_velocity),
            angular=self._to_vector(odometry.angular_velocity),
        )
        return self._resolve("nav_msgs/msg/Odometry")(
            header=self.header(odometry.stamp_ns, MAP_FRAME),
            child_frame_id=base_link(odometry.vue_id),
            pose=self._resolve("geometry_msgs/msg/PoseWithCovariance")(
                pose=self._to_pose(odometry.position, odometry.quaternion),
                covariance=flat(odometry.pose_cov),
            ),
            twist=self._resolve("geometry_msgs/msg/TwistWithCovariance")(
                twist=twist, covariance=flat(odometry.twist_cov)
            ),
        )

    @staticmethod
    def odometry_from_msg(msg: Any) -> Odometry:
        """Odometry value of a nav_msgs/Odometry."""
        q = msg.pose.pose.orientation
        return Odometry(
            stamp_ns=stamp_ns(msg.header.stamp),
            vue_id=vue_of_frame(msg.child_frame_id),
            position=xyz(msg.pose.pose.position),
            quaternion=np.array([q.x, q.y, q.z, q.w], dtype=np.float64),
            linear_velocity=xyz(msg.twist.twist.linear),
            angular_velocity=xyz(msg.twist.twist.angular),
            pose_cov=square(msg.pose.covariance, 6),
            twist_cov=square(msg.twist.covariance, 6),
        )

    def imu_to_msg(self, imu: ImuSample) -> Any:
        """sensor_msgs/Imu without orientation (covariance[0] = -1, REP-145)."""
        return self._resolve("sensor_msgs/msg/Imu")(
            header=self.header(imu.stamp_ns, base_link(imu.vue_id)),
            orientation=self._to_quaternion(np.array([0.0, 0.0, 0.0, 1.0])),
            orientation_covariance=imu_covariance(-1.0),
            angular_velocity=self._to_vector(imu.angular_velocity),
            angular_velocity_covariance=imu_covariance(imu.angular_velocity_var),
            linear_acceleration=self._to_vector(imu.specific_force),
            linear_acceleration_covariance=imu_covariance(imu.specific_force_var),
        )

    @staticmethod
    def imu_from_msg(msg: Any, vue_id: str | None = None) -> ImuSample:
        """ImuSample value of a sensor_msgs/Imu of a device (default: the one its frame names)."""
        return ImuSample(
            stamp_ns=stamp_ns(msg.header.stamp),
            vue_id=vue_id or vue_of_frame(msg.header.frame_id),
            angular_velocity=xyz(msg.angular_velocity),
            specific_force=xyz(msg.linear_acceleration),
            angular_velocity_var=float(msg.angular_velocity_covariance[0]),
            specific_force_var=float(msg.linear_acceleration_covariance[0]),
        )

    def magnetic_field_to_msg(self, mag: MagneticSample) -> Any:
        """sensor_msgs/MagneticField."""
        return self._resolve("sensor_msgs/msg/MagneticField")(
            header=self.header(mag.stamp_ns, base_link(mag.vue_id)),
            magnetic_field=self._to_vector(mag.magnetic_field),
            magnetic_field_covariance=flat(np.eye(3) * mag.magnetic_field_var),
        )

    @staticmethod
    def magnetic_field_from_msg(msg: Any) -> MagneticSample:
        """MagneticSample value of a sensor_msgs/MagneticField."""
        return MagneticSample(
            stamp_ns=stamp_ns(msg.header.stamp),
            vue_id=vue_of_frame(msg.header.frame_id),
            magnetic_field=xyz(msg.magnetic_field),
            magnetic_field_var=float(msg.magnetic_field_covariance[0]),
        )

    def velocity_to_msg(self, velocity: Velocity) -> Any:
        """geometry_msgs/TwistWithCovarianceStamped in the axes of ``frame_id``."""
        linear = np.array([velocity.velocity[0], velocity.velocity[1], 0.0])
        return self._resolve("geometry_msgs/msg/TwistWithCovarianceStamped")(
            header=self.header(velocity.stamp_ns, velocity.frame_id),
            twist=self._resolve("geometry_msgs/msg/TwistWithCovariance")(
                twist=self._resolve("geometry_msgs/msg/Twist")(
                    linear=self._to_vector(linear), angular=self._to_vector(np.zeros(3))
                ),
                covariance=embed(velocity.cov),
            ),
        )

    @staticmethod
    def velocity_from_msg(msg: Any, vue_id: str, source: str = "step_velocity") -> Velocity:
        """Velocity value of a TwistWithCovarianceStamped; the topic names the device."""
        return Velocity(
            stamp_ns=stamp_ns(msg.header.stamp),
            vue_id=vue_id,
            frame_id=msg.header.frame_id,
            velocity=xyz(msg.twist.twist.linear)[:2],
            cov=square(msg.twist.covariance, 6)[:2, :2].copy(),
            source=source,
        )

    @staticmethod
    def ground_speed_from_msg(msg: Any, vue_id: str) -> GroundSpeed:
        """GroundSpeed value of a TwistWithCovarianceStamped in base_link axes: linear.x and its
        variance."""
        return GroundSpeed(
            stamp_ns=stamp_ns(msg.header.stamp),
            vue_id=vue_id,
            speed_mps=float(msg.twist.twist.linear.x),
            speed_var=float(msg.twist.covariance[0]),
        )

    def initial_pose_to_msg(self, pose: InitialPose) -> Any:
        """geometry_msgs/PoseWithCovarianceStamped; orientation is left at identity and is not
        used."""
        return self._resolve("geometry_msgs/msg/PoseWithCovarianceStamped")(
            header=self.header(pose.stamp_ns, MAP_FRAME),
            pose=self._resolve("geometry_msgs/msg/PoseWithCovariance")(
                pose=self._to_pose(pose.position, np.array([0.0, 0.0, 0.0, 1.0])),
                covariance=embed(pose.cov),
            ),
        )

    @staticmethod
    def initial_pose_from_msg(msg: Any, vue_id: str) -> InitialPose:
        """InitialPose value of a PoseWithCovarianceStamped; the topic names the device."""
        return InitialPose(
            stamp_ns=stamp_ns(msg.header.stamp),
            vue_id=vue_id,
            position=xyz(msg.pose.pose.position),
            cov=square(msg.pose.covariance, 6)[:3, :3].copy(),
        )

    def transform_to_msg(self, odometry: Odometry) -> Any:
        """tf2_msgs/TFMessage with map -> base_link."""
        transform = self._resolve("geometry_msgs/msg/Transform")(
            translation=self._to_vector(odometry.position),
            rotation=self._to_quaternion(odometry.quaternion),
        )
        stamped = self._resolve("geometry_msgs/msg/TransformStamped")(
            header=self.header(odometry.stamp_ns, MAP_FRAME),
            child_frame_id=base_link(odometry.vue_id),
            transform=transform,
        )
        return self._resolve("tf2_msgs/msg/TFMessage")(transforms=[stamped])


def _step_calibration(msg: Any) -> StepCalibration:
    """What a netpos_msgs/TrackStatus says of the steps; recordings may be older than that."""
    if not hasattr(msg, "step_length_factor"):
        return StepCalibration()
    return StepCalibration(
        length_factor=float(msg.step_length_factor),
        length_factor_sd=float(msg.step_length_factor_sd),
        heading_offset_rad=float(msg.step_heading_offset),
        heading_offset_sd_rad=float(msg.step_heading_offset_sd),
    )
