"""Which value travels on which topic as which message; names are those of ``messages.topics``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from netpos.messages import topics
from netpos.messages.codec import Codec
from netpos.messages.values import (
    Beacon,
    ClockState,
    ImuSample,
    InitialPose,
    MagneticSample,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    Step,
    Velocity,
)
from netpos.scenario.schema import Scenario

Value = (
    RsuInfo
    | RsuMeasurement
    | Odometry
    | ClockState
    | Beacon
    | ImuSample
    | MagneticSample
    | InitialPose
    | Step
    | Velocity
)

_OF_DEVICE: dict[type, tuple[str, str]] = {
    InitialPose: (topics.INITIAL_POSE, "geometry_msgs/msg/PoseWithCovarianceStamped"),
    Odometry: (topics.GROUND_TRUTH, "nav_msgs/msg/Odometry"),
    ClockState: (topics.GROUND_TRUTH_CLOCK, "netpos_msgs/msg/ClockState"),
    ImuSample: (topics.IMU, "sensor_msgs/msg/Imu"),
    MagneticSample: (topics.MAG, "sensor_msgs/msg/MagneticField"),
    Beacon: (topics.BEACON, "netpos_msgs/msg/Beacon"),
}

_OF_PDR: dict[type, tuple[str, str]] = {
    Step: (topics.STEP, "netpos_msgs/msg/Step"),
    Velocity: (topics.STEP_VELOCITY, "geometry_msgs/msg/TwistWithCovarianceStamped"),
}


def topic_of(value: Value) -> str:
    """Topic of a simulated value; an Odometry or a ClockState is the truth here."""
    if isinstance(value, RsuInfo):
        return topics.RSU_INFO
    if isinstance(value, RsuMeasurement):
        return topics.RSU_MEASUREMENTS
    return topics.of_vue(value.vue_id, {**_OF_DEVICE, **_OF_PDR}[type(value)][0])


def device_topics(scenario: Scenario) -> dict[str, str]:
    """Message type by topic of everything the scenario's devices emit."""
    types = {}
    for vue_id, device in scenario.each_device:
        absent = {
            InitialPose: device.initial_pose_sd_m is None,
            ImuSample: device.imu is None,
            MagneticSample: device.magnetometer is None,
        }
        for kind, (name, type_name) in _OF_DEVICE.items():
            if not absent.get(kind, False):
                types[topics.of_vue(vue_id, name)] = type_name
    return types


def to_message(codec: Codec, value: Value) -> Any:
    """The message of a value."""
    convert: dict[type, Callable[[Any], Any]] = {
        RsuInfo: codec.rsu_info_to_msg,
        RsuMeasurement: codec.measurement_to_msg,
        InitialPose: codec.initial_pose_to_msg,
        Odometry: codec.odometry_to_msg,
        ClockState: codec.clock_state_to_msg,
        ImuSample: codec.imu_to_msg,
        MagneticSample: codec.magnetic_field_to_msg,
        Step: codec.step_to_msg,
        Velocity: codec.velocity_to_msg,
        Beacon: codec.beacon_to_msg,
    }
    return convert[type(value)](value)
