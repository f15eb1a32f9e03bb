"""Every conversion to a message, to bytes and back, through rosbags' classes."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.bags import codec, typestore
from netpos.messages.fields import (
    base_link,
    certain_stamp_ns,
    malformed_nanosec,
    stamp_ns,
    vue_of_frame,
)
from netpos.messages.values import (
    AngleConvention,
    Beacon,
    ClockState,
    Field,
    GroundSpeed,
    ImuSample,
    InitialPose,
    MagneticSample,
    Odometry,
    RsuErrors,
    RsuInfo,
    RsuMeasurement,
    Step,
    StepCalibration,
    TrackMode,
    TrackState,
    TrackStatus,
    Velocity,
)

STAMP = 1_700_000_000_123_456_789
LAST_STAMP = (2**31 - 1) * 10**9 + 999_999_999


def numbers(n: int, start: float = 1.0) -> np.ndarray:
    """n different values, none of them 0."""
    return start + np.arange(n) * 0.125


def over_the_wire(msg: Any) -> Any:
    """The message after serialisation and back."""
    store = typestore()
    return store.deserialize_cdr(store.serialize_cdr(msg, msg.__msgtype__), msg.__msgtype__)


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    assert is_dataclass(a)
    for entry in fields(a):
        x, y = getattr(a, entry.name), getattr(b, entry.name)
        if isinstance(x, np.ndarray):
            np.testing.assert_array_equal(x, y, err_msg=entry.name)
            assert y.dtype == np.float64
        else:
            assert x == y, entry.name
            assert type(x) is type(y), entry.name


BEACON = Beacon(
    stamp_ns=STAMP,
    vue_id="vue_7",
    sequence=4_000_000_000,
    position=numbers(3),
    clock_offset_s=1e-5,
)
INFO = RsuInfo(
    stamp_ns=STAMP,
    rsu_id="rsu 3",
    network="uwb",
    position=numbers(3, 2.0),
    quaternion=numbers(4, 0.1),
    azimuth_bias_sd_rad=0.01,
    elevation_bias_sd_rad=0.02,
    range_bias_sd_m=0.03,
    bias_correlation_time_s=0.04,
    common_range_bias_sd_m=0.05,
    common_bias_correlation_time_s=0.06,
    noise_correlation_time_s=0.07,
    angle_convention=AngleConvention.CONE,
    baseline_m=0.08,
    wavelength_m=0.09,
)
MEASUREMENT = RsuMeasurement(
    stamp_ns=STAMP,
    rsu_id="rsu_3",
    vue_id="vue_7",
    sequence=17,
    expected=5,
    fields=Field.AZIMUTH | Field.POSITION,
    line_of_sight=False,
    rssi_dbm=-71.5,
    azimuth_rad=0.1,
    azimuth_var=0.2,
    elevation_rad=0.3,
    elevation_var=0.4,
    toa_s=0.5,
    toa_var=0.6,
    range_m=0.7,
    range_var=0.8,
    phase_difference_rad=0.9,
    phase_difference_var=1.1,
    position=numbers(3, 5.0),
    position_cov=numbers(9, 6.0).reshape(3, 3),
)
CLOCK = ClockState(
    stamp_ns=STAMP, vue_id="vue_7", offset_s=2e-5, drift=3e-6, cov=numbers(4).reshape(2, 2)
)
STATUS = TrackStatus(
    stamp_ns=STAMP,
    vue_id="vue_7",
    state=TrackState.COASTING,
    nis=1.5,
    nis_dof=3,
    used=2,
    accepted=2**40,
    rejected={"gate": 3, "late": 2**35},
    sources=("rsu_1", "step_velocity"),
    position_sd_m=0.25,
    protection_level_m=4.5,
    steps=StepCalibration(
        length_factor=1.1,
        length_factor_sd=0.02,
        heading_offset_rad=-0.3,
        heading_offset_sd_rad=0.04,
    ),
    modes=(TrackMode(weight=0.7, x_m=1.0, y_m=-2.0), TrackMode(weight=0.3, x_m=3.0, y_m=4.0)),
)
ODOMETRY = Odometry(
    stamp_ns=STAMP,
    vue_id="vue_7",
    position=numbers(3),
    quaternion=numbers(4, 0.2),
    linear_velocity=numbers(3, 7.0),
    angular_velocity=numbers(3, 8.0),
    pose_cov=numbers(36).reshape(6, 6),
    twist_cov=numbers(36, 50.0).reshape(6, 6),
)
ERRORS = RsuErrors(
    stamp_ns=STAMP,
    rsu_id="rsu_3",
    vue_id="vue_7",
    quantities=("RANGE", "AZIMUTH"),
    scatter=(1.1, 0.9),
    bias=(0.2, -0.03),
    bias_sd=(0.05, 0.01),
    bias_spread=(0.3, 0.04),
    correlation_time_s=(30.0, 75.0),
    stretch=(0.07, 0.0),
    stretch_sd=(0.002, 0.0),
)
IMU = ImuSample(
    stamp_ns=STAMP,
    vue_id="vue_7",
    angular_velocity=numbers(3),
    specific_force=numbers(3, 9.0),
    angular_velocity_var=0.01,
    specific_force_var=0.02,
)
MAG = MagneticSample(
    stamp_ns=STAMP, vue_id="vue_7", magnetic_field=numbers(3), magnetic_field_var=0.5
)

ROUND_TRIPS = [
    (BEACON, "beacon_to_msg", "beacon_from_msg", "netpos_msgs/msg/Beacon"),
    (INFO, "rsu_info_to_msg", "rsu_info_from_msg", "netpos_msgs/msg/RsuInfo"),
    (MEASUREMENT, "measurement_to_msg", "measurement_from_msg", "netpos_msgs/msg/RsuMeasurement"),
    (CLOCK, "clock_state_to_msg", "clock_state_from_msg", "netpos_msgs/msg/ClockState"),
    (STATUS, "track_status_to_msg", "track_status_from_msg", "netpos_msgs/msg/TrackStatus"),
    (ODOMETRY, "odometry_to_msg", "odometry_from_msg", "nav_msgs/msg/Odometry"),
    (IMU, "imu_to_msg", "imu_from_msg", "sensor_msgs/msg/Imu"),
    (ERRORS, "rsu_errors_to_msg", "rsu_errors_from_msg", "netpos_msgs/msg/RsuErrors"),
    (MAG, "magnetic_field_to_msg", "magnetic_field_from_msg", "sensor_msgs/msg/MagneticField"),
]


@pytest.mark.parametrize(
    ("value", "to_msg", "from_msg", "type_name"), ROUND_TRIPS, ids=[r[3] for r in ROUND_TRIPS]
)
def test_round_trip(value: Any, to_msg: str, from_msg: str, type_name: str) -> None:
    """Every field, each with its own value, survives message and bytes."""
    msg = getattr(codec(), to_msg)(value)
    assert msg.__msgtype__ == type_name
    assert_same(value, getattr(codec(), from_msg)(over_the_wire(msg)))


def test_defaults_survive_too() -> None:
    info = RsuInfo(rsu_id="r", position=np.zeros(3))
    assert_same(info, codec().rsu_info_from_msg(over_the_wire(codec().rsu_info_to_msg(info))))
    m = RsuMeasurement(stamp_ns=1, rsu_id="r", vue_id="v")
    assert_same(m, codec().measurement_from_msg(over_the_wire(codec().measurement_to_msg(m))))
    s = TrackStatus(stamp_ns=1, vue_id="v", state=TrackState.WAITING)
    assert_same(s, codec().track_status_from_msg(over_the_wire(codec().track_status_to_msg(s))))


def test_velocity_round_trip_takes_the_device_from_the_topic() -> None:
    value = Velocity(
        stamp_ns=STAMP,
        vue_id="vue_7",
        frame_id="vue_7/pdr_start",
        velocity=np.array([1.0, -2.0]),
        cov=np.array([[0.5, 0.1], [0.1, 0.7]]),
        source="shoe",
    )
    msg = over_the_wire(codec().velocity_to_msg(value))
    assert_same(value, codec().velocity_from_msg(msg, "vue_7", "shoe"))
    assert codec().velocity_from_msg(msg, "other").vue_id == "other"
    assert codec().velocity_from_msg(msg, "other").source == "step_velocity"
    assert msg.twist.twist.linear.z == 0.0
    assert (msg.twist.twist.angular.x, msg.twist.twist.angular.z) == (0.0, 0.0)
    assert np.count_nonzero(msg.twist.covariance) == 4


def test_initial_pose_round_trip() -> None:
    cov = np.array([[4.0, 1.0, 0.1], [1.0, 9.0, 0.2], [0.1, 0.2, 2.0]])
    value = InitialPose(stamp_ns=STAMP, vue_id="vue_7", position=numbers(3), cov=cov)
    msg = over_the_wire(codec().initial_pose_to_msg(value))
    assert_same(value, codec().initial_pose_from_msg(msg, "vue_7"))
    assert msg.header.frame_id == "map"
    assert np.count_nonzero(msg.pose.covariance) == 9
    q = msg.pose.pose.orientation
    assert (q.x, q.y, q.z, q.w) == (0.0, 0.0, 0.0, 1.0)


def test_ground_speed_is_linear_x_and_its_variance() -> None:
    msg = codec().velocity_to_msg(
        Velocity(
            stamp_ns=STAMP, vue_id="v", velocity=np.array([3.0, 9.0]), cov=np.diag([0.04, 7.0])
        )
    )
    assert codec().ground_speed_from_msg(over_the_wire(msg), "vue_7") == GroundSpeed(
        stamp_ns=STAMP, vue_id="vue_7", speed_mps=3.0, speed_var=0.04
    )


def test_step_message() -> None:
    step = Step(
        stamp_ns=STAMP + 3,
        vue_id="vue_7",
        frame_id="vue_7/pdr_start",
        start_ns=STAMP + 1,
        end_ns=STAMP + 2,
        count=12,
        length_m=0.7,
        length_var=0.01,
        heading_rad=-1.5,
        heading_var=0.02,
        cadence_hz=1.9,
    )
    msg = over_the_wire(codec().step_to_msg(step))
    assert msg.__msgtype__ == "netpos_msgs/msg/Step"
    assert msg.header.frame_id == "vue_7/pdr_start"
    assert [stamp_ns(t) - STAMP for t in (msg.start, msg.end, msg.header.stamp)] == [1, 2, 3]
    assert (msg.count, msg.length, msg.length_var) == (12, 0.7, 0.01)
    assert (msg.heading, msg.heading_var, msg.cadence) == (-1.5, 0.02, 1.9)


def test_a_status_of_before_steps_were_calibrated() -> None:
    """A recording of then holds the fields there were."""
    msg = codec().track_status_to_msg(STATUS)
    old = SimpleNamespace(**{k: v for k, v in vars(msg).items() if not k.startswith("step_")})
    expected = replace(STATUS, steps=StepCalibration())
    assert_same(expected, codec().track_status_from_msg(old))


def test_errors_of_before_distances_were_stretched() -> None:
    msg = codec().rsu_errors_to_msg(ERRORS)
    old = SimpleNamespace(**{k: v for k, v in vars(msg).items() if not k.startswith("stretch")})
    expected = replace(ERRORS, stretch=(0.0, 0.0), stretch_sd=(0.0, 0.0))
    assert_same(expected, codec().rsu_errors_from_msg(old))


def test_transform_is_the_pose_of_the_odometry() -> None:
    msg = over_the_wire(codec().transform_to_msg(ODOMETRY))
    assert msg.__msgtype__ == "tf2_msgs/msg/TFMessage"
    (one,) = msg.transforms
    assert (one.header.frame_id, one.child_frame_id) == ("map", "vue_7/base_link")
    assert stamp_ns(one.header.stamp) == STAMP
    t, q = one.transform.translation, one.transform.rotation
    np.testing.assert_array_equal([t.x, t.y, t.z], ODOMETRY.position)
    np.testing.assert_array_equal([q.x, q.y, q.z, q.w], ODOMETRY.quaternion)


def test_frames() -> None:
    """REP-105 names; poses in map, the twist and everything of the body in base_link."""
    c = codec()
    assert c.odometry_to_msg(ODOMETRY).header.frame_id == "map"
    assert c.odometry_to_msg(ODOMETRY).child_frame_id == "vue_7/base_link"
    for msg in (
        c.beacon_to_msg(BEACON),
        c.rsu_info_to_msg(INFO),
        c.measurement_to_msg(MEASUREMENT),
    ):
        assert msg.header.frame_id == "map"
    for msg in (
        c.clock_state_to_msg(CLOCK),
        c.track_status_to_msg(STATUS),
        c.imu_to_msg(IMU),
        c.magnetic_field_to_msg(MAG),
    ):
        assert msg.header.frame_id == "vue_7/base_link"
    assert vue_of_frame(base_link("a/b")) == "a/b"


def test_imu_states_that_it_has_no_orientation() -> None:
    """REP-145: -1 in the first covariance entry; the variance is on each axis."""
    msg = over_the_wire(codec().imu_to_msg(IMU))
    assert msg.orientation_covariance.tolist() == [-1.0] + [0.0] * 8
    assert (msg.orientation.x, msg.orientation.w) == (0.0, 1.0)
    np.testing.assert_array_equal(
        msg.angular_velocity_covariance.reshape(3, 3), np.diag([0.01] * 3)
    )
    np.testing.assert_array_equal(
        msg.linear_acceleration_covariance.reshape(3, 3), np.diag([0.02] * 3)
    )
    mag = over_the_wire(codec().magnetic_field_to_msg(MAG))
    np.testing.assert_array_equal(mag.magnetic_field_covariance.reshape(3, 3), np.diag([0.5] * 3))


def test_status_counts_are_parallel_sorted_and_summed() -> None:
    msg = over_the_wire(codec().track_status_to_msg(STATUS))
    assert list(msg.rejection_reasons) == ["gate", "late"]
    assert msg.rejection_counts.tolist() == [3, 2**35]
    assert msg.rejected == 3 + 2**35
    broken = codec().track_status_to_msg(STATUS)
    broken.rejection_counts = broken.rejection_counts[:1]
    with pytest.raises(ValueError):
        codec().track_status_from_msg(broken)


def test_unknown_constants_are_errors_or_kept() -> None:
    msg = codec().rsu_info_to_msg(INFO)
    msg.angle_convention = 7
    with pytest.raises(ValueError, match="7"):
        codec().rsu_info_from_msg(msg)
    m = codec().measurement_to_msg(MEASUREMENT)
    m.fields = 64 | 1  # judged by the tracker, not here
    assert int(codec().measurement_from_msg(m).fields) == 65


@pytest.mark.parametrize(
    ("ns", "sec", "nanosec"),
    [
        (0, 0, 0),
        (1, 0, 1),
        (999_999_999, 0, 999_999_999),
        (1_000_000_000, 1, 0),
        (1_000_000_001, 1, 1),
        (LAST_STAMP, 2**31 - 1, 999_999_999),
        (STAMP, 1_700_000_000, 123_456_789),
    ],
)
def test_stamps_at_nanosecond_boundaries(ns: int, sec: int, nanosec: int) -> None:
    msg = over_the_wire(codec().time(ns))
    assert (msg.sec, msg.nanosec) == (sec, nanosec)
    assert stamp_ns(msg) == ns
    assert stamp_ns(over_the_wire(codec().clock_to_msg(ns)).clock) == ns


@settings(max_examples=200, deadline=None)
@given(st.integers(0, LAST_STAMP))
def test_stamps_survive_exactly(ns: int) -> None:
    header = over_the_wire(codec().header(ns, "map"))
    assert stamp_ns(header.stamp) == ns
    assert 0 <= header.stamp.nanosec < 10**9


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(allow_nan=False), min_size=13, max_size=13), st.integers(0, 63))
def test_measurements_survive_bit_by_bit(values: list[float], flags: int) -> None:
    names = ["azimuth_rad", "elevation_rad", "toa_s", "range_m", "phase_difference_rad"]
    numbers = dict(zip(names, values, strict=False))
    m = RsuMeasurement(
        stamp_ns=STAMP,
        rsu_id="r",
        vue_id="v",
        fields=Field(flags),
        position=np.array(values[5:8]),
        position_cov=np.array([values[8:11]] * 3),
        **numbers,
    )
    assert_same(m, codec().measurement_from_msg(over_the_wire(codec().measurement_to_msg(m))))


@pytest.mark.parametrize("nanosec", [10**9, 4 * 10**9, 2**32 - 1])
def test_a_time_that_is_none_is_known_as_such(nanosec: int) -> None:
    make = codec()
    time = make.time(1)
    for sec in (-(2**31), 0, 7, 2**31 - 1):
        time.sec, time.nanosec = sec, nanosec
        ns = stamp_ns(time)
        assert -(2**63) <= ns < -(2**31) * 10**9
        assert malformed_nanosec(ns) == nanosec
        with pytest.raises(ValueError, match=f"nanosec is {nanosec}; send one below 1000000000"):
            certain_stamp_ns(time)


@pytest.mark.parametrize(
    ("sec", "nanosec"), [(0, 0), (-(2**31), 0), (2**31 - 1, 10**9 - 1), (-1, 5)]
)
def test_a_time_is_its_nanoseconds(sec: int, nanosec: int) -> None:
    time = codec().time(sec * 10**9 + nanosec)
    assert (time.sec, time.nanosec) == (sec, nanosec)
    assert stamp_ns(time) == certain_stamp_ns(time) == sec * 10**9 + nanosec
    assert malformed_nanosec(stamp_ns(time)) is None


def test_nobody_else_judges_these_stamps() -> None:
    """The values of all other messages go through the door of a tracker."""
    make = codec()
    state = ClockState(stamp_ns=5, vue_id="v", offset_s=0.0, drift=0.0)
    message = make.clock_state_to_msg(state)
    message.header.stamp.nanosec = 10**9
    with pytest.raises(ValueError, match="nanosec is 1000000000"):
        make.clock_state_from_msg(message)
