"""The short way between values and bytes against the long one: codec and rosbags' serialiser."""

from __future__ import annotations

import struct
from dataclasses import astuple, fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.bags import BagError, cdr_codec, codec, typestore
from netpos.bags.types import flat_items
from netpos.messages.cdr import Layout
from netpos.messages.values import (
    ClockState,
    Field,
    ImuSample,
    Odometry,
    RsuMeasurement,
    StepCalibration,
    TrackMode,
    TrackState,
    TrackStatus,
)
from rosbags.serde import SerdeError

MEASUREMENT = "netpos_msgs/msg/RsuMeasurement"
IMU = "sensor_msgs/msg/Imu"

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
stamps = st.integers(0, 2**31 * 10**9 - 1)
doubles = st.floats(width=64)
counts = st.integers(0, 2**32 - 1)


def array(*shape: int) -> st.SearchStrategy[np.ndarray]:
    n = int(np.prod(shape))
    return st.lists(doubles, min_size=n, max_size=n).map(lambda v: np.array(v).reshape(shape))


SCALARS = [entry.name for entry in fields(RsuMeasurement) if entry.type == "float"]
measurements = st.builds(
    RsuMeasurement,
    stamp_ns=stamps,
    rsu_id=texts,
    vue_id=texts,
    sequence=counts,
    expected=counts,
    fields=counts.map(Field),
    line_of_sight=st.booleans(),
    **dict.fromkeys(SCALARS, doubles),
    position=array(3) | st.just(np.zeros(3)),
    position_cov=array(3, 3) | st.just(np.zeros((3, 3))),
)
imu_samples = st.builds(
    ImuSample,
    stamp_ns=stamps,
    vue_id=texts,
    angular_velocity=array(3),
    specific_force=array(3),
    angular_velocity_var=doubles,
    specific_force_var=doubles,
)
odometries = st.builds(
    Odometry,
    stamp_ns=stamps,
    vue_id=texts,
    position=array(3),
    quaternion=array(4),
    linear_velocity=array(3),
    angular_velocity=array(3),
    pose_cov=array(6, 6),
    twist_cov=array(6, 6),
)
clock_states = st.builds(
    ClockState, stamp_ns=stamps, vue_id=texts, offset_s=doubles, drift=doubles, cov=array(2, 2)
)
statuses = st.builds(
    TrackStatus,
    stamp_ns=stamps,
    vue_id=texts,
    state=st.sampled_from(TrackState),
    nis=doubles,
    nis_dof=counts,
    used=counts,
    accepted=st.integers(0, 2**64 - 1),
    rejected=st.dictionaries(texts, st.integers(0, 2**60), max_size=4),
    sources=st.lists(texts, max_size=4).map(tuple),
    position_sd_m=doubles,
    protection_level_m=doubles,
    steps=st.builds(
        StepCalibration,
        length_factor=doubles,
        length_factor_sd=doubles,
        heading_offset_rad=doubles,
        heading_offset_sd_rad=doubles,
    ),
    modes=st.lists(st.builds(TrackMode, weight=doubles, x_m=doubles, y_m=doubles), max_size=4).map(
        tuple
    ),
)


def serialise(msg: Any, *, little_endian: bool = True) -> bytes:
    store = typestore()
    return bytes(store.serialize_cdr(msg, msg.__msgtype__, little_endian=little_endian))


def bits(value: Any) -> list[Any]:
    """Fields with their types, floats by their bits."""
    return [
        (type(v), np.asarray(v).tobytes() if isinstance(v, (float, np.ndarray)) else v)
        for v in astuple(value)
    ]


def the_long_way(cdr: bytes, type_name: str) -> Any:
    msg = typestore().deserialize_cdr(cdr, type_name)
    return codec().imu_from_msg(msg) if type_name == IMU else codec().measurement_from_msg(msg)


def the_short_way(cdr: bytes, type_name: str) -> Any:
    return cdr_codec().imu(cdr) if type_name == IMU else cdr_codec().measurement(cdr)


@settings(max_examples=150, deadline=None)
@given(measurements)
def test_measurements(value: RsuMeasurement) -> None:
    cdr = serialise(codec().measurement_to_msg(value))
    read = cdr_codec().measurement(cdr)
    assert bits(read) == bits(the_long_way(cdr, MEASUREMENT)) == bits(value)


@settings(max_examples=60, deadline=None)
@given(imu_samples)
def test_imu_samples(value: ImuSample) -> None:
    cdr = serialise(codec().imu_to_msg(value))
    assert bits(cdr_codec().imu(cdr)) == bits(the_long_way(cdr, IMU))


@settings(max_examples=60, deadline=None)
@given(odometries)
def test_odometry_and_transform(value: Odometry) -> None:
    assert cdr_codec().odometry(value) == serialise(codec().odometry_to_msg(value))
    assert cdr_codec().transform(value) == serialise(codec().transform_to_msg(value))


@settings(max_examples=60, deadline=None)
@given(clock_states)
def test_clock_states(value: ClockState) -> None:
    assert cdr_codec().clock_state(value) == serialise(codec().clock_state_to_msg(value))


@settings(max_examples=150, deadline=None)
@given(statuses)
def test_statuses(value: TrackStatus) -> None:
    assert cdr_codec().track_status(value) == serialise(codec().track_status_to_msg(value))


def test_covariances_that_are_no_plain_block_of_doubles() -> None:
    """Transposed, a part of a larger one, or of integers: what counts is the matrix."""
    whole = np.arange(49.0).reshape(7, 7)
    value = Odometry(
        stamp_ns=1,
        vue_id="v",
        position=np.array([1, 2, 3]),
        quaternion=np.array([0, 0, 0, 1]),
        linear_velocity=whole[:3, 2],
        pose_cov=whole.T[:6, :6],
        twist_cov=np.arange(36).reshape(6, 6),
    )
    assert cdr_codec().odometry(value) == serialise(codec().odometry_to_msg(value))


SAMPLES = {
    MEASUREMENT: serialise(
        codec().measurement_to_msg(
            RsuMeasurement(
                stamp_ns=5, rsu_id="rsu_12", vue_id="vue_1", fields=Field.RANGE, range_m=2.0
            )
        )
    ),
    IMU: serialise(
        codec().imu_to_msg(
            ImuSample(
                stamp_ns=5, vue_id="v", angular_velocity=np.ones(3), specific_force=np.ones(3)
            )
        )
    ),
}


@pytest.mark.parametrize("type_name", SAMPLES)
def test_cut_or_longer_messages_are_left_to_the_long_way(type_name: str) -> None:
    whole = SAMPLES[type_name]
    for length in range(len(whole)):
        assert the_short_way(whole[:length], type_name) is None
    for extra in range(4):  # as padding may do
        assert the_short_way(whole + bytes(extra), type_name) is not None
        the_long_way(whole + bytes(extra), type_name)
    assert the_short_way(whole + bytes(4), type_name) is None
    with pytest.raises(SerdeError):
        the_long_way(whole + bytes(4), type_name)


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(sorted(SAMPLES)), st.data())
def test_of_damaged_bytes_no_other_value_is_read(type_name: str, data: st.DataObject) -> None:
    cdr = bytearray(SAMPLES[type_name])
    for _ in range(data.draw(st.integers(1, 3))):
        cdr[data.draw(st.integers(0, 60))] = data.draw(st.integers(0, 255))
    read = the_short_way(bytes(cdr), type_name)
    if read is not None:
        assert bits(read) == bits(the_long_way(bytes(cdr), type_name))


def test_the_other_byte_order_and_encodings_are_left_to_the_long_way() -> None:
    value = RsuMeasurement(stamp_ns=5, rsu_id="a", vue_id="b", toa_s=1.0)
    msg = codec().measurement_to_msg(value)
    assert cdr_codec().measurement(serialise(msg, little_endian=False)) is None
    assert cdr_codec().measurement(b"\0\7" + serialise(msg)[2:]) is None


def test_text_that_is_no_utf8_or_has_no_end_is_left_to_the_long_way() -> None:
    whole = SAMPLES[MEASUREMENT]
    start = whole.index(b"rsu_12\0")
    assert cdr_codec().measurement(whole.replace(b"rsu_12", b"rsu_1\xff")) is None
    assert cdr_codec().measurement(whole[: start + 6] + b"!" + whole[start + 7 :]) is None


@pytest.mark.parametrize(
    "change", [{"stamp_ns": 2**31 * 10**9}, {"used": -1}, {"nis_dof": 2**32}, {"accepted": 2**64}]
)
def test_what_does_not_fit_its_field_is_an_error(change: dict[str, int]) -> None:
    status = TrackStatus(stamp_ns=1, vue_id="v", state=TrackState.WAITING)
    with pytest.raises(struct.error):
        cdr_codec().track_status(replace(status, **change))


names = st.sampled_from(["", "a", "b", "ab", "ba", "rsu_1", "rsu_2", "rsu_12"])
strings = st.builds(
    RsuMeasurement, stamp_ns=stamps, rsu_id=names, vue_id=names, sequence=counts, toa_s=doubles
)


@settings(max_examples=80, deadline=None)
@given(st.lists(strings, min_size=2, max_size=6), st.integers(0, 3), st.data())
def test_what_was_read_before_changes_nothing(
    values: list[RsuMeasurement], cut: int, data: st.DataObject
) -> None:
    """One layout for messages in turn, of like sizes and like strings in other places; then a byte
    of one of them is another, and it is cut or padded."""
    layout = Layout(flat_items(MEASUREMENT))
    cdrs = [serialise(codec().measurement_to_msg(value)) for value in values]
    for cdr in [*cdrs, *reversed(cdrs)]:
        assert repr(layout.unpack(cdr)) == repr(Layout(flat_items(MEASUREMENT)).unpack(cdr))
    damaged = bytearray(data.draw(st.sampled_from(cdrs)))
    damaged[data.draw(st.integers(0, 60))] ^= data.draw(st.integers(1, 255))
    for other in (bytes(damaged), cdrs[0][: len(cdrs[0]) - cut], cdrs[0] + b"\0" * cut):
        assert repr(layout.unpack(other)) == repr(Layout(flat_items(MEASUREMENT)).unpack(other))


def test_names_are_not_kept_without_end() -> None:
    layout = Layout(["I", "string", "d"])
    for number in range(3 * 4096):
        assert layout.unpack(_named(number))[:2] == [7, f"n{number}"]
    assert len(layout._middles) <= 4096
    assert layout.unpack(_named(5)) == [7, "n5", 0.0]


def _named(number: int) -> bytes:
    return Layout(["I", "string", "d"]).pack(7, f"n{number}", 0.0)


def test_types_are_flattened_to_their_fields() -> None:
    header = ["i", "I", "string"]
    assert list(flat_items("netpos_msgs/msg/ClockState")) == [*header, "d", "d", "4d"]
    assert list(flat_items("netpos_msgs/msg/Beacon")) == [*header, "string", "I", *"dddd"]
    status = list(flat_items("netpos_msgs/msg/TrackStatus"))
    assert status == [
        *header,
        *"BdIIQQ",
        "string[]",
        "Q[]",
        "string[]",
        *"dddddd",
        "d[]",
        "d[]",
        "d[]",
        "string",
    ]
    with pytest.raises(BagError, match="transforms cannot be laid out"):
        list(flat_items("tf2_msgs/msg/TFMessage"))


def test_a_type_with_sequences_is_not_read() -> None:
    assert Layout(["I[]", "d"]).unpack(b"\0\1\0\0" + bytes(16)) is None
    assert Layout(["I", "d"]).unpack(b"\0\1\0\0" + bytes(16)) == [0, 0.0]


@pytest.mark.parametrize("nanosec", [10**9, 4 * 10**9, 2**32 - 1])
def test_a_time_that_is_none_is_left_to_the_codec_of_messages(nanosec: int) -> None:
    fast, make = cdr_codec(), codec()
    for type_name, read in ((MEASUREMENT, fast.measurement), (IMU, fast.imu)):
        store = typestore()
        value = (
            make.measurement_to_msg(RsuMeasurement(stamp_ns=5, rsu_id="a", vue_id="v"))
            if type_name == MEASUREMENT
            else make.imu_to_msg(
                ImuSample(
                    stamp_ns=5,
                    vue_id="v",
                    angular_velocity=np.zeros(3),
                    specific_force=np.zeros(3),
                )
            )
        )
        value.header.stamp.nanosec = 10**9 - 1
        assert read(bytes(store.serialize_cdr(value, type_name))).stamp_ns == 10**9 - 1
        value.header.stamp.nanosec = nanosec
        assert read(bytes(store.serialize_cdr(value, type_name))) is None


@given(measurements)
def test_the_source_of_a_measurement_is_read_alone(value: RsuMeasurement) -> None:
    message = codec().measurement_to_msg(value)
    cdr = bytes(typestore().serialize_cdr(message, MEASUREMENT))
    source = cdr_codec().source(cdr)
    assert source in (None, (value.rsu_id, value.vue_id, value.stamp_ns))
    assert (source is None) == (cdr_codec().measurement(cdr) is None)
