"""``netpos.write_bag``: what goes in comes out, and what cannot be tracked is refused.

What ``read_bag`` returns names its bag."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import netpos
import numpy as np
import pytest
import yaml
from imported_bag import values
from netpos.bags import BagError, BagReader
from netpos.messages import ImuSample, Odometry

RSUS = [
    netpos.RsuInfo(rsu_id=name, position=np.array([x, 0.0, 2.0]))
    for name, x in (("a", 0.0), ("b", 10.0))
]


def measured(stamp_ns: int, rsu_id: str, vue_id: str = "vue_1") -> netpos.RsuMeasurement:
    return netpos.RsuMeasurement(
        stamp_ns=stamp_ns,
        rsu_id=rsu_id,
        vue_id=vue_id,
        fields=netpos.RsuMeasurement.RANGE,
        range_m=5.0,
        range_var=0.01,
    )


def truth(stamp_ns: int) -> Odometry:
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id="vue_1",
        position=np.array([1.0, 2.0, 3.0]),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        linear_velocity=np.zeros(3),
    )


def test_any_order_goes_in_and_beacons_are_numbered(tmp_path: Path) -> None:
    given = [measured(20, "b"), measured(10, "a"), measured(20, "a")]
    written = netpos.write_bag(
        tmp_path / "bag",
        rsus=RSUS,
        measurements=given,
        truth=[truth(30), truth(5)],
        tracker={"device_height_m": 1.5},
        metadata={"source": "a test"},
    )
    assert len(written.rsus) == 2
    assert len(written.measurements) == 3
    assert {vue: len(poses) for vue, poses in written.truth.items()} == {"vue_1": 2}
    infos, messages, poses = values(tmp_path / "bag")
    assert [info.stamp_ns for info in infos] == [5, 5]
    assert [(m.stamp_ns, m.rsu_id, m.sequence, m.expected) for m in messages] == [
        (10, "a", 0, 1),
        (20, "a", 1, 2),
        (20, "b", 1, 2),
    ]
    assert [pose.stamp_ns for pose in poses] == [5, 30]
    with BagReader(tmp_path / "bag") as bag:
        assert yaml.safe_load(bag.metadata["tracker"]) == {"device_height_m": 1.5}
        assert bag.metadata["source"] == "a test"


def test_two_devices_at_one_stamp_are_two_beacons(tmp_path: Path) -> None:
    given = [measured(20, "a", "vue_2"), measured(20, "a", "vue_1")]
    netpos.write_bag(tmp_path / "bag", rsus=RSUS, measurements=given)
    _, messages, _ = values(tmp_path / "bag")
    assert [(m.vue_id, m.sequence, m.expected) for m in messages] == [
        ("vue_1", 0, 1),
        ("vue_2", 1, 1),
    ]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([], "there is no measurement"),
        ([measured(10, "c")], "no position of RSU c; give an RsuInfo of each .there are a, b"),
        ([measured(0, "a")], "stamp 0 ns is not > 0; add a constant"),
        ([measured(10, "a")] * 2, "RSU a measures vue_1 twice at stamp 10 ns"),
    ],
)
def test_refuses_what_cannot_be_tracked(
    tmp_path: Path, given: list[netpos.RsuMeasurement], message: str
) -> None:
    with pytest.raises(BagError, match=message):
        netpos.write_bag(tmp_path / "bag", rsus=RSUS, measurements=given)
    assert not (tmp_path / "bag").exists()


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    netpos.write_bag(tmp_path / "bag", rsus=RSUS, measurements=[measured(10, "a")])
    with pytest.raises(FileExistsError):
        netpos.write_bag(tmp_path / "bag", rsus=RSUS, measurements=[replace(measured(10, "a"))])


def test_a_recording_names_its_bag_and_what_is_in_it(tmp_path: Path) -> None:
    """It says so without reading messages: a bag that is gone still has its name."""
    given = [measured(10**9, "a"), measured(3 * 10**9, "b")]
    bag = tmp_path / "a_walk"
    written = netpos.write_bag(bag, rsus=RSUS, measurements=given, truth=[truth(2 * 10**9)])
    bag.rename(tmp_path / "elsewhere")
    assert repr(written) == (
        f"Recording({str(bag)!r}): 2.0 s, 2 measurements, tracks of no device, "
        "ground truth of vue_1"
    )
    assert Path(written) == bag
    with pytest.raises(BagError, match="does not exist"):
        _ = written.measurements


def test_samples_of_an_imu_are_kept_by_device(tmp_path: Path) -> None:
    samples = [
        ImuSample(
            stamp_ns=k, vue_id=vue, angular_velocity=np.zeros(3), specific_force=np.full(3, k)
        )
        for k, vue in ((2, "tag_b"), (1, "tag_a"), (3, "tag_b"))
    ]
    given = [measured(1, "a")]
    written = netpos.write_bag(tmp_path / "bag", rsus=RSUS, measurements=given, imu=samples)
    forces = {vue: [s.specific_force[0] for s in kept] for vue, kept in written.imu.items()}
    assert forces == {"tag_a": [1.0], "tag_b": [2.0, 3.0]}
