"""Values to messages of common_interfaces and back, for any message classes with their fields.

``CommonCodec(resolve)`` takes a function that returns the class of a type name such as
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
    certain_stamp_ns,
    embed,
    flat,
    imu_covariance,
    square,
    stamp_ns,
    vue_of_frame,
    xyz,
)
from netpos.messages.values import (
    Array,
    GroundSpeed,
    ImuSample,
    InitialPose,
    MagneticSample,
    Odometry,
    Velocity,
)


class CommonCodec:
    """Builds and reads messages of common_interfaces; ``resolve`` maps type names to classes."""

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
            stamp_ns=certain_stamp_ns(msg.header.stamp),
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
            frame_id=msg.header.frame_id,
            position=xyz(msg.pose.pose.position),
            cov=square(msg.pose.covariance, 6)[:3, :3].copy(),
        )

    def fix_to_msg(self, stamp_ns: int, frame_id: str, place: Array, cov: Array) -> Any:
        """sensor_msgs/NavSatFix of latitude, longitude [deg], height [m] (3,) and the covariance
        (3, 3) in local east, north and up [m^2]."""
        status = self._resolve("sensor_msgs/msg/NavSatStatus")(status=0, service=0)
        return self._resolve("sensor_msgs/msg/NavSatFix")(
            header=self.header(stamp_ns, frame_id),
            status=status,
            latitude=float(place[0]),
            longitude=float(place[1]),
            altitude=float(place[2]),
            position_covariance=flat(cov),
            position_covariance_type=3,  # all of it is known
        )

    @staticmethod
    def pose_of_transform(msg: Any) -> tuple[int, Array, Array]:
        """Stamp [ns], translation (3,) and rotation (4,) x y z w of a TransformStamped."""
        q = msg.transform.rotation
        rotation = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
        return stamp_ns(msg.header.stamp), xyz(msg.transform.translation), rotation

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
