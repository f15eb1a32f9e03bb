"""The trolley importer against values worked out by hand, and the real recording where it is at
hand."""

from __future__ import annotations

import math
import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from imported_bag import values
from netpos.bags import BagError, BagReader
from netpos.bags.importers import import_uwb_trolley
from netpos.bags.importers.common import UWB_DATA_SHEET
from netpos.bags.importers.uwb_trolley import TAGS_M
from netpos.messages.values import Field, Odometry
from netpos.scenario.settings import bag_settings
from netpos.tracking import TrackerConfig

DATA = Path(os.environ.get("NETPOS_DATA", Path(__file__).parents[6] / "shared" / "data"))
DISTANCES = [round(2.0 + 0.1 * link, 1) for link in range(24)]
FIRST = "2022-08-15 9:42:24.766," + ",".join(map(str, DISTANCES))
SECOND = "2022-08-15 9:42:24.775," + ",".join(map(str, DISTANCES[:21])) + ",,,"
SHORT = FIRST.replace("24.766", "24.770").replace(",2.3,", ",")
UWB = f"{FIRST}\n{SECOND}\n"
# north at 1 m/s; heading 170 deg, then 190 deg, then 210 deg
TRUTH_TIMES = ("9:42:24.700", "9:42:24.700", "9:42:24.720", "9:42:24.800", "9:42:24.900")
TRUTH_POSES = ((0.0, 170.0), (0.5, 0.0), (0.5, 0.0), (0.1, 190.0), (0.2, 210.0))
T0_NS = 1_660_556_544_700_000_000


def pose_line(time: str, y: float, heading_deg: float) -> str:
    half = math.radians(heading_deg) / 2.0
    return f"2022-08-15 {time},1.0,{y},0.96,0.01,{math.cos(half)},{math.sin(half)},0.02"


MOTION = "\n".join(
    ["time,x,y,z,rotation,,,"]
    + [pose_line(time, *pose) for time, pose in zip(TRUTH_TIMES, TRUTH_POSES, strict=True)]
)


def trolley_folder(path: Path, uwb: str = UWB, motion: str = MOTION) -> Path:
    path.mkdir()
    (path / "UWB_test.csv").write_text(uwb)
    (path / "motion_capture_test.csv").write_text(motion)
    return path


def heading(odometry: Odometry) -> float:
    return 2.0 * math.atan2(odometry.quaternion[2], odometry.quaternion[3])


def test_links_and_ranges_by_hand(tmp_path: Path) -> None:
    counts = import_uwb_trolley(trolley_folder(tmp_path / "in"), tmp_path / "bag")
    assert counts == {"/rsu/info": 24, "/rsu/measurements": 45, "/vue_1/ground_truth": 3}
    infos, measured, _ = values(tmp_path / "bag")
    known = {info.rsu_id: info for info in infos}
    assert len(known) == 24
    np.testing.assert_array_equal(known["a5_t1"].position, [-0.0072, -2.9652, 1.0444])
    assert {info.network for info in infos} == {f"a{k}" for k in range(8)}
    assert known["a5_t0"].network == known["a5_t2"].network == "a5"
    first = {m.rsu_id: m for m in measured if m.sequence == 0}
    second = {m.rsu_id: m for m in measured if m.sequence == 1}
    assert {m.stamp_ns for m in first.values()} == {T0_NS + 66_000_000}
    assert {m.stamp_ns for m in second.values()} == {T0_NS + 75_000_000}
    assert [first[f"a{k // 3}_t{k % 3}"].range_m for k in range(24)] == DISTANCES
    assert {m.expected for m in first.values()} == {24}
    assert {m.expected for m in second.values()} == {21}
    assert not {"a7_t0", "a7_t1", "a7_t2"} & second.keys()
    assert first["a3_t2"].fields == Field.RANGE
    assert first["a3_t2"].range_var == UWB_DATA_SHEET.range_sd_m**2
    np.testing.assert_array_equal(first["a3_t2"].lever_arm, [0.2034, 0.1451, -0.0008])


def test_truth_by_hand(tmp_path: Path) -> None:
    """Thinned to steps of at least 50 ms; the heading passes 180 deg at 200 deg/s."""
    import_uwb_trolley(trolley_folder(tmp_path / "in"), tmp_path / "bag")
    _, _, truth = values(tmp_path / "bag")
    assert [t.stamp_ns - T0_NS for t in truth] == [0, 100_000_000, 200_000_000]
    assert [tuple(t.position) for t in truth] == [(1, 0, 0.96), (1, 0.1, 0.96), (1, 0.2, 0.96)]
    for odometry, degrees in zip(truth, (170.0, 190.0, 210.0), strict=True):
        error = math.remainder(heading(odometry) - math.radians(degrees), math.tau)
        assert abs(error) < 1e-12
        assert odometry.angular_velocity[2] == pytest.approx(math.radians(200.0))
        angle = math.radians(degrees)
        ahead = [math.sin(angle), math.cos(angle), 0.0]
        np.testing.assert_allclose(odometry.linear_velocity, ahead, atol=1e-9)


def test_tracker_parameters_are_in_the_bag(tmp_path: Path) -> None:
    import_uwb_trolley(trolley_folder(tmp_path / "in"), tmp_path / "bag")
    with BagReader(tmp_path / "bag") as reader:
        config = TrackerConfig.from_mapping(bag_settings(reader).parameters)
    assert config.motion_model == "rigid_body"
    assert config.device_height_m == 0.97


@pytest.mark.parametrize(
    ("uwb", "motion", "message"),
    [
        (UWB.replace(",2.3,", ",x,"), MOTION, "line 1: distance a1-t0 'x' is not a number"),
        (UWB.replace(",2.3,", ",nan,"), MOTION, "line 1: distance a1-t0 is nan, not finite"),
        (UWB.replace(",2.3,", ",-2.3,"), MOTION, "a1-t0 -2.3 m is not positive"),
        (f"{FIRST}\n{SHORT}\n{SECOND}\n", MOTION, "line 2: 24 fields, 25 expected"),
        (UWB.replace("24.775", "24.766"), MOTION, "line 2: time does not increase"),
        (UWB.replace("9:42:24.775", "noon"), MOTION, "line 2: time '2022-08-15 noon' is not like"),
        (UWB, MOTION.replace("9:42:24.9", "9:42:23.9") + "\n", "line 6: time decreases"),
        (UWB, MOTION.replace(",0.1,", ",inf,"), "line 5: y is inf"),
        (UWB, "\n".join(MOTION.split("\n")[:3]), "shorter than 0.1 s"),
        ("", MOTION, "holds no data"),
    ],
)
def test_refuses(tmp_path: Path, uwb: str, motion: str, message: str) -> None:
    with pytest.raises(BagError, match=message):
        import_uwb_trolley(trolley_folder(tmp_path / "in", uwb, motion), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_missing_and_doubled_files(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="not a folder"):
        import_uwb_trolley(tmp_path / "nowhere", tmp_path / "bag")
    folder = trolley_folder(tmp_path / "in")
    (folder / "UWB_second.csv").write_text(UWB)
    with pytest.raises(BagError, match=r"holds 2 files UWB_\*.csv"):
        import_uwb_trolley(folder, tmp_path / "bag")
    (folder / "UWB_second.csv").unlink()
    import_uwb_trolley(folder, tmp_path / "bag")
    with pytest.raises(FileExistsError, match="never overwritten"):
        import_uwb_trolley(folder, tmp_path / "bag")


def test_real_recording(tmp_path: Path) -> None:
    """The first 30 s: distances fit the truth only where its heading turns the tags' places."""
    folder = DATA / "uwb_trolley"
    if not folder.is_dir():
        pytest.skip(f"no recording in {folder}; set NETPOS_DATA")
    (ranges_file,), (motion_file,) = folder.glob("UWB_*.csv"), folder.glob("motion_capture_*.csv")
    start = "\n".join(ranges_file.read_text().split("\n")[:3000])
    source = trolley_folder(tmp_path / "in", start, motion_file.read_text())
    import_uwb_trolley(source, tmp_path / "bag")
    infos, measured, truth = values(tmp_path / "bag")
    assert len(measured) == 24 * 3000 - 3  # one line has no anchor 7
    assert set(Counter(m.sequence for m in measured).values()) == {21, 24}
    stamps = np.array([t.stamp_ns for t in truth])
    track = np.array([t.position for t in truth])
    yaw = np.unwrap([heading(t) for t in truth])
    places = {info.rsu_id: info.position for info in infos}
    spreads, bare = [], []
    for link, anchor in places.items():
        of_link = [m for m in measured[::5] if m.rsu_id == link]
        stamp_ns = np.array([m.stamp_ns for m in of_link])
        p = np.column_stack([np.interp(stamp_ns, stamps, track[:, axis]) for axis in range(3)])
        turn = np.interp(stamp_ns, stamps, yaw)
        x, y, z = TAGS_M[int(link[-1])]
        c, s = np.cos(turn), np.sin(turn)
        arm = np.column_stack([c * x - s * y, s * x + c * y, np.full(len(stamp_ns), z)])
        ranges = np.array([m.range_m for m in of_link])
        error = ranges - np.linalg.norm(p + arm - anchor, axis=1)
        assert 0.0 < np.median(error) < 0.5
        spreads.append(error.std())
        bare.append((ranges - np.linalg.norm(p - anchor, axis=1)).std())
    assert np.mean(spreads) < 0.1
    assert np.mean(bare) > 1.3 * np.mean(spreads)
