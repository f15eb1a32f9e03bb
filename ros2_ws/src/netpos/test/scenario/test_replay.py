"""Which messages a replay takes as input, and how it reads them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.bags import BagError, BagReader, BagWriter, codec, typestore
from netpos.bags.types import definition
from netpos.messages.values import (
    ClockState,
    Field,
    GroundSpeed,
    ImuSample,
    InitialPose,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    TrackStatus,
    Velocity,
)
from netpos.scenario.replay import reading_of, replay_bag, write_output
from netpos.scenario.settings import bag_settings
from netpos.tracking import TrackerConfig, TrackOutput

NS = 10**9
USUAL = {"tracker": "{}"}  # the tracker's defaults
MEASURED = RsuMeasurement(
    stamp_ns=5 * NS,
    rsu_id="a",
    vue_id="car",
    expected=1,
    fields=Field.POSITION,
    position=np.array([1.0, 2.0, 3.0]),
    position_cov=np.eye(3),
)
MOVED = Velocity(stamp_ns=6 * NS, vue_id="car", velocity=np.array([3.0, 4.0]), cov=np.eye(2))
PLACED = InitialPose(stamp_ns=7 * NS, vue_id="car", position=np.ones(3), cov=np.eye(3))
SHAKEN = ImuSample(
    stamp_ns=8 * NS, vue_id="car", angular_velocity=np.ones(3), specific_force=np.ones(3)
)


class WithImu:
    """A configuration under which the tracker takes inertial samples."""

    use_imu = True


def read(path: Path, config: Any) -> list[Any]:
    """Tracker input of a bag, in its order."""
    with BagReader(path) as bag:
        readings = {name: reading_of(name, info, config) for name, info in bag.topics.items()}
        entries = [(readings[e.topic], e) for e in bag.messages()]
        return [reading(entry) for reading, entry in entries if reading is not None]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    make = codec()
    with BagWriter(tmp_path / "bag", metadata=USUAL) as out:
        out.write("/clock", make.clock_to_msg(0), 0)
        out.write("/rsu/measurements", make.measurement_to_msg(MEASURED), 1)
        out.write("/car/step_velocity", make.velocity_to_msg(MOVED), 2)
        out.write("/car/ground_speed", make.velocity_to_msg(MOVED), 3)
        out.write("/car/initialpose", make.initial_pose_to_msg(PLACED), 4)
        out.write("/car/imu", make.imu_to_msg(replace(SHAKEN, vue_id="sensor")), 5)
        out.write("/car/ground_truth_clock", make.clock_to_msg(0), 6)
    return tmp_path / "bag"


def test_every_kind_of_input_is_read(bag: Path) -> None:
    speed = GroundSpeed(stamp_ns=6 * NS, vue_id="car", speed_mps=3.0, speed_var=1.0)
    expected = [MEASURED, MOVED, speed, PLACED]
    assert list(map(repr, read(bag, TrackerConfig()))) == list(map(repr, expected))
    # the topic names the device, whatever the frame of the sensor is called
    assert list(map(repr, read(bag, WithImu))) == list(map(repr, [*expected, SHAKEN]))


@pytest.mark.parametrize(
    ("name", "value", "is_read"),
    [
        ("backend", "compiled", True),
        ("backend", "filterpy", False),
        ("sector_probability", "0.999", True),
        ("sector_probability", "0.9", False),
    ],
)
def test_a_bag_of_a_tracker_with_a_removed_parameter(
    name: str, value: str, is_read: bool, tmp_path: Path
) -> None:
    """Read where every tracker now does what the parameter said."""
    told = {"tracker": f"{name}: {value}\nhold_s: 0.5\n"}
    with BagWriter(tmp_path / "bag", metadata=told) as out:
        out.write("/rsu/measurements", codec().measurement_to_msg(MEASURED), 1)
    with BagReader(tmp_path / "bag") as bag:
        parameters = bag_settings(bag).parameters
    if is_read:
        assert TrackerConfig.from_mapping(parameters) == TrackerConfig(hold_s=0.5)
    else:
        with pytest.raises(ValueError, match=f"unknown tracker parameter '{name}'"):
            TrackerConfig.from_mapping(parameters)


def test_the_other_byte_order_is_read_too(tmp_path: Path) -> None:
    msg = codec().measurement_to_msg(MEASURED)
    cdr = bytes(typestore().serialize_cdr(msg, msg.__msgtype__, little_endian=False))
    with BagWriter(tmp_path / "bag", metadata=USUAL) as out:
        out.write_raw("/rsu/measurements", msg.__msgtype__, cdr, 1)
    (value,) = read(tmp_path / "bag", TrackerConfig())
    assert repr(value) == repr(MEASURED)


def test_a_bag_with_its_own_definition_is_read_by_that(tmp_path: Path) -> None:
    """Its measurements begin with one more field; by our definition they are nonsense."""
    type_name = "netpos_msgs/msg/RsuMeasurement"
    text = "uint64 odd\n" + definition(type_name)
    msg = codec().measurement_to_msg(MEASURED)
    usual = bytes(typestore().serialize_cdr(msg, type_name))
    with BagWriter(tmp_path / "bag", metadata=USUAL) as out:
        out.add_topic("/rsu/measurements", type_name, text=text)
        out.write_raw("/rsu/measurements", type_name, usual[:4] + bytes(8) + usual[4:], 1)
    (value,) = read(tmp_path / "bag", TrackerConfig())
    assert repr(value) == repr(MEASURED)


def test_damaged_input_is_named(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", metadata=USUAL) as out:
        type_name = "netpos_msgs/msg/RsuMeasurement"
        out.write_raw("/rsu/measurements", type_name, b"\0\1\0\0" + bytes(30), 1)
    with pytest.raises(BagError, match="/rsu/measurements"):
        replay_bag(tmp_path / "bag", tmp_path / "out")


def test_a_bag_without_measurements_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", metadata=USUAL) as out:
        out.write("/clock", codec().clock_to_msg(0), 0)
    with pytest.raises(BagError, match="record that topic to replay"):
        replay_bag(tmp_path / "bag", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_all_input_is_copied_and_old_estimates_are_not(tmp_path: Path) -> None:
    make = codec()
    estimate = ClockState(stamp_ns=NS, vue_id="car", offset_s=7.0, drift=0.0)
    with BagWriter(tmp_path / "bag", metadata=USUAL) as out:
        out.write("/rsu/info", make.rsu_info_to_msg(RsuInfo(rsu_id="a", position=np.ones(3))), 0)
        out.write("/rsu/measurements", make.measurement_to_msg(MEASURED), 5 * NS)
        out.write("/car/clock_state", make.clock_state_to_msg(estimate), 5 * NS)
        out.write("/car/imu", make.imu_to_msg(SHAKEN), 8 * NS)
    assert replay_bag(tmp_path / "bag", tmp_path / "out").epochs == 1
    with BagReader(tmp_path / "bag") as bag, BagReader(tmp_path / "out") as again:
        kept = ["/rsu/info", "/rsu/measurements", "/car/imu"]
        copied = [(e.topic, e.log_time_ns, e.cdr) for e in again.messages(kept)]
        assert copied == [(e.topic, e.log_time_ns, e.cdr) for e in bag.messages(kept)]
        assert set(again.topics) == {*kept, "/car/odometry", "/tf", "/car/track_status"}


def test_what_there_is_of_an_output_is_written_at_its_stamp(tmp_path: Path) -> None:
    status = TrackStatus(stamp_ns=3 * NS, vue_id="car", state=TrackState.TRACKING)
    pose = Odometry(
        stamp_ns=3 * NS,
        vue_id="car",
        position=np.ones(3),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        linear_velocity=np.ones(3),
    )
    clock = ClockState(stamp_ns=3 * NS, vue_id="car", offset_s=1e-6, drift=0.0)
    with BagWriter(tmp_path / "bag", metadata=USUAL) as out:
        write_output(out, TrackOutput(None, None, status))
        write_output(out, TrackOutput(pose, clock, status))
    with BagReader(tmp_path / "bag") as bag:
        entries = list(bag.messages())
    assert [e.topic for e in entries] == [
        "/car/track_status",
        "/car/odometry",
        "/tf",
        "/car/clock_state",
        "/car/track_status",
    ]
    assert {e.log_time_ns for e in entries} == {3 * NS}
    assert [e.message.__msgtype__.rsplit("/")[-1] for e in entries[1:4]] == [
        "Odometry",
        "TFMessage",
        "ClockState",
    ]


def test_a_replay_that_does_not_end_well_leaves_no_bag(tmp_path: Path) -> None:
    """Not even one that looks finished."""
    with BagWriter(tmp_path / "in", metadata=USUAL) as bag:
        known = RsuInfo(rsu_id="b", position=np.zeros(3), stamp_ns=NS)
        bag.write("/rsu/info", codec().rsu_info_to_msg(known), NS)
        for k in range(3):
            stamp = (5 + k) * NS
            moved = replace(MEASURED, stamp_ns=stamp)
            bag.write("/rsu/measurements", codec().measurement_to_msg(moved), stamp)
    for error in (KeyboardInterrupt, RuntimeError):

        def stop(done: int, error: type[BaseException] = error) -> None:
            if done == 1:
                raise error

        with pytest.raises(error):
            replay_bag(tmp_path / "in", tmp_path / "out", progress=stop)
        assert not (tmp_path / "out").exists()
    summary = replay_bag(tmp_path / "in", tmp_path / "out")
    assert summary.estimates == 0  # nobody has said where RSU a is
    with pytest.raises(FileExistsError):
        replay_bag(tmp_path / "in", tmp_path / "out")
    assert (tmp_path / "out/metadata.yaml").is_file()
