"""Importers against values worked out by hand, and the real recordings where they are at hand."""

from __future__ import annotations

import math
import os
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest
from imported_bag import values
from netpos.bags import BagError, BagReader
from netpos.bags.importers import import_ble_aoa, import_uwb_anchors
from netpos.bags.importers.common import truth_of_poses
from netpos.messages.values import Array, Field, Odometry
from scipy.spatial.transform import Rotation

DATA = Path(os.environ.get("NETPOS_DATA", Path(__file__).parents[6] / "shared" / "data"))
BEACONS = """\
1000,8401,-70,-45,-12,-75,37,6502
1000,8401,-60,10,0,-75,38,6503
1300,8401,-68,0,-30,-66,39,6502
"""
TRUTH = """\
1000,NaN,600,100
1200,NaN,600,100
1400,NaN,600,120
1800,NaN,560,120
"""
ANCHOR = """\
%time,field.stamp,field.id,field.x,field.y,field.z,field.distanceFromTag,field.rssi,field.rssi_fp
9,1000000000,3,1,2,0.5,5.5,-79.5,-80
9,1100000000,3,1,2,0.5,5.6,-79.25,-80
"""
TRACK = """\
timestamp,x,y,z,heading_degrees
1.0e+9,0.0,0.0,0.0,90.0
1.125e+9,0.0,0.25,0.0,99.0
1.25e+9,0.0,0.5,0.1,108.0
"""


def ble_folder(path: Path, beacons: str = BEACONS, truth: str = TRUTH) -> Path:
    path.mkdir(exist_ok=True)
    (path / "beacons_uc1_run1.csv").write_text(beacons)
    (path / "truth_uc1_run1.csv").write_text(truth)
    return path


def uwb_folder(path: Path, anchor: str = ANCHOR, track: str = TRACK) -> Path:
    path.mkdir(exist_ok=True)
    (path / "A3.csv").write_text(anchor)
    (path / "trajectory.csv").write_text(track)
    return path


@pytest.mark.parametrize(
    ("beacons", "truth"),
    [
        (BEACONS + "1400,8401,-6", TRUTH),  # the last line was cut
        (BEACONS + "1400,8401,-60,10,0,-75,38,65", TRUTH),  # within its last field
        ("0,0,-75,38,6503\n" + BEACONS, TRUTH),  # the first was
        (BEACONS, TRUTH + "19"),
    ],
)
def test_a_cut_first_or_last_line_is_skipped_and_counted(
    tmp_path: Path, beacons: str, truth: str
) -> None:
    counts = import_ble_aoa(ble_folder(tmp_path / "ble", beacons, truth), tmp_path / "bag")
    whole = {"/rsu/info": 4, "/rsu/measurements": 3, "/vue_1/ground_truth": 9}
    assert counts == {**whole, "cut lines skipped": 1}


def test_ble_as_published(tmp_path: Path) -> None:
    for kind, name, text in (("beacons", "beacons", BEACONS), ("gt", "gt", TRUTH)):
        for run in (1, 2):
            folder = tmp_path / "mobility" / kind / "use-case 1"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{name}_mobility_use-case1_run{run}.txt").write_text(text)
    counts = import_ble_aoa(tmp_path / "mobility", tmp_path / "bag", run="uc1_run2")
    assert counts == {"/rsu/info": 4, "/rsu/measurements": 3, "/vue_1/ground_truth": 9}
    with BagReader(tmp_path / "bag") as bag:
        assert bag.metadata["source"] == "ble-aoa uc1_run2"
    with pytest.raises(BagError, match="holds the runs uc1_run1, uc1_run2; choose one"):
        import_ble_aoa(tmp_path, tmp_path / "other")


def test_a_power_that_is_not_finite_is_not_measured(tmp_path: Path) -> None:
    folder = uwb_folder(tmp_path / "uwb", ANCHOR.replace("-79.25", "-inf"))
    counts = import_uwb_anchors(folder, tmp_path / "bag")
    assert counts["RSSI not finite, taken as not measured"] == 1
    _, measured, _ = values(tmp_path / "bag")
    assert [m.rssi_dbm for m in measured] == [-79.5, 0.0]


def test_ble_by_hand(tmp_path: Path) -> None:
    counts = import_ble_aoa(ble_folder(tmp_path / "ble"), tmp_path / "bag")
    assert counts == {"/rsu/info": 4, "/rsu/measurements": 3, "/vue_1/ground_truth": 9}
    infos, measured, truth = values(tmp_path / "bag")

    facing = {i.rsu_id: Rotation.from_quat(i.quaternion).apply([1, 0, 0]) for i in infos}
    np.testing.assert_allclose(facing["6501"], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(facing["6502"], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(facing["6503"], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(facing["6504"], [0, -1, 0], atol=1e-12)
    np.testing.assert_array_equal(infos[2].position, [12, 3, 2.3])

    first = measured[0]  # -45 deg as written is 45 deg to the left of +y: north-west
    assert (first.rsu_id, first.vue_id, first.stamp_ns) == ("6502", "vue_1", 1_000_000_000)
    assert first.azimuth_rad == pytest.approx(math.pi / 4)
    assert first.elevation_rad == pytest.approx(math.radians(-12))
    assert first.fields == Field.AZIMUTH | Field.ELEVATION
    assert first.rssi_dbm == -70
    assert [(m.sequence, m.expected) for m in measured] == [(0, 2), (0, 2), (1, 1)]

    x = [t.position[0] for t in truth]
    y = [t.position[1] for t in truth]
    np.testing.assert_allclose(x, [6, 6, 6, 6, 6, 5.9, 5.8, 5.7, 5.6], atol=1e-12)
    np.testing.assert_allclose(y, [1, 1, 1, 1.1, 1.2, 1.2, 1.2, 1.2, 1.2], atol=1e-12)
    assert [t.linear_velocity[0] for t in truth] == pytest.approx([0, 0, 1, 1, 1, 1, 1, 1, 1])
    yaw = [Rotation.from_quat(t.quaternion).as_euler("ZYX")[0] for t in truth]
    np.testing.assert_allclose(yaw[2:], [math.pi / 2] * 2 + [math.pi] * 5, atol=1e-12)


def test_a_person_stands_at_a_corner_until_departure(tmp_path: Path) -> None:
    """1 m in 0.2 s, 0.4 s of standing, 1 m in 0.2 s."""
    corners = "1000,NaN,0,0\n1200,1600,100,0\n1800,NaN,100,100\n"
    import_ble_aoa(ble_folder(tmp_path / "ble", truth=corners), tmp_path / "bag")
    _, _, truth = values(tmp_path / "bag")
    assert [t.stamp_ns // 10**6 for t in truth] == [*range(1000, 1801, 100)]
    positions = np.array([t.position[:2] for t in truth])
    np.testing.assert_allclose(positions[:, 0], [0, 0.5, 1, 1, 1, 1, 1, 1, 1], atol=1e-12)
    np.testing.assert_allclose(positions[:, 1], [0, 0, 0, 0, 0, 0, 0, 0.5, 1], atol=1e-12)
    speeds = [t.linear_velocity[0] for t in truth]
    assert speeds == pytest.approx([5, 5, 0, 0, 0, 0, 5, 5, 5])


def test_uwb_by_hand(tmp_path: Path) -> None:
    counts = import_uwb_anchors(uwb_folder(tmp_path / "LOS"), tmp_path / "bag")
    assert counts == {"/rsu/info": 1, "/rsu/measurements": 2, "/vue_1/ground_truth": 3}
    infos, measured, truth = values(tmp_path / "bag")
    assert infos[0].rsu_id == "A3"
    np.testing.assert_array_equal(infos[0].position, [1, 2, 0.5])
    assert [m.range_m for m in measured] == [5.5, 5.6]
    assert [m.stamp_ns for m in measured] == [1_000_000_000, 1_100_000_000]
    assert measured[0].fields == Field.RANGE
    assert measured[0].range_var > 0
    assert [t.stamp_ns for t in truth] == [1_000_000_000, 1_125_000_000, 1_250_000_000]
    # heading north, moving north at 2 m/s: straight ahead; turning left at 9 deg in 1/8 s
    np.testing.assert_allclose(truth[0].linear_velocity, [2, 0, 0], atol=1e-9)
    assert truth[1].angular_velocity[2] == pytest.approx(math.radians(72))
    ahead = [2 * math.cos(math.radians(9)), -2 * math.sin(math.radians(9)), 0.4]
    np.testing.assert_allclose(truth[1].linear_velocity, ahead, atol=1e-9)


def test_a_heading_that_passes_180_degrees_does_not_spin() -> None:
    headings = np.radians([170.0, 179.0, -172.0])
    poses = np.column_stack([np.zeros((3, 3)), headings])
    truth = truth_of_poses([0, 125_000_000, 250_000_000], poses, "vue_1")
    for odometry in truth:
        assert odometry.angular_velocity[2] == pytest.approx(math.radians(72))


@pytest.mark.parametrize(
    ("beacons", "truth", "message"),
    [
        (BEACONS.replace("-45", "x"), TRUTH, r"beacons_uc1_run1.csv, line 1: azimuth 'x' is not"),
        (BEACONS.replace(",-30,", ",nan,"), TRUTH, "line 3: elevation is nan, not finite"),
        (BEACONS.replace("6503", "6509"), TRUTH, "line 2: anchor '6509' is none of 6501"),
        (BEACONS.replace(",38,", ","), TRUTH, "line 2: 7 fields, 8 expected"),
        (BEACONS.replace("-45", "181"), TRUTH, "line 1: azimuth 181.0 deg is outside"),
        (BEACONS.replace("1300,8401", "1300,8402"), TRUTH, "line 3: tag 8402"),
        (BEACONS.replace("1300", "-1"), TRUTH, "line 3: time -1 is negative"),
        (BEACONS.replace("6503", "6502"), TRUTH, "measures vue_1 twice at stamp 1000000000"),
        ("", TRUTH, "holds no data"),
        (BEACONS, TRUTH.replace("1400", "1200"), r"truth_uc1_run1.csv, line 3: time does not"),
        (BEACONS, "1,NaN,1,1\n", "holds one corner"),
        (BEACONS, TRUTH.replace("1200,NaN", "1200,1200"), "line 2: the departure is not after"),
        (BEACONS, TRUTH.replace("1200,NaN", "1200,1400"), "line 3: time does not increase"),
        (BEACONS, TRUTH.replace("1200,NaN", "1200,soon"), "line 2: departure 'soon' is not"),
    ],
)
def test_ble_refuses(tmp_path: Path, beacons: str, truth: str, message: str) -> None:
    with pytest.raises(BagError, match=message):
        import_ble_aoa(ble_folder(tmp_path / "ble", beacons, truth), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("anchor", "track", "message"),
    [
        (ANCHOR.replace("5.6", "inf"), TRACK, r"A3.csv, line 3: distance is inf"),
        (ANCHOR.replace("5.5", "-5.5"), TRACK, "line 2: distance -5.5 m is not positive"),
        (ANCHOR.replace("3,1,2,0.5,5.6", "3,1,2,0.6,5.6"), TRACK, "line 3: anchor moved"),
        (ANCHOR, TRACK.replace("1.25e+9", "1.0e+9"), "trajectory.csv, line 4: time does not"),
        (ANCHOR, TRACK.split("1.125", maxsplit=1)[0], "holds one pose"),
    ],
)
def test_uwb_refuses(tmp_path: Path, anchor: str, track: str, message: str) -> None:
    with pytest.raises(BagError, match=message):
        import_uwb_anchors(uwb_folder(tmp_path / "LOS", anchor, track), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_choice_of_run_and_missing_paths(tmp_path: Path) -> None:
    folder = ble_folder(tmp_path / "ble")
    (folder / "beacons_uc1_run2.csv").write_text(BEACONS)
    with pytest.raises(BagError, match="runs uc1_run1, uc1_run2; choose one with --run"):
        import_ble_aoa(folder, tmp_path / "bag")
    with pytest.raises(BagError, match="no run 'uc9'"):
        import_ble_aoa(folder, tmp_path / "bag", run="uc9")
    with pytest.raises(BagError, match=r"truth_uc1_run2.csv does not exist"):
        import_ble_aoa(folder, tmp_path / "bag", run="uc1_run2")
    with pytest.raises(BagError, match="does not exist"):
        import_ble_aoa(tmp_path / "nowhere", tmp_path / "bag")
    with pytest.raises(BagError, match="not a folder"):
        import_uwb_anchors(tmp_path / "nowhere", tmp_path / "bag")
    with pytest.raises(BagError, match="no anchor file"):
        import_uwb_anchors(folder, tmp_path / "bag")
    import_ble_aoa(folder / "beacons_uc1_run1.csv", tmp_path / "bag")
    with pytest.raises(FileExistsError, match="never overwritten"):
        import_ble_aoa(folder, tmp_path / "bag", run="uc1_run1")


def interpolated(truth: list[Odometry], stamp_ns: int) -> Array:
    stamps = [t.stamp_ns for t in truth]
    track = np.array([t.position for t in truth])
    return np.array([np.interp(stamp_ns, stamps, track[:, axis]) for axis in range(3)])


def residuals(bag: Path) -> dict[str, Array]:
    """Per RSU (n, 3): azimuth, elevation, range minus what the truth says, in the RSU's axes.

    Only while the device moves: a person who stands repeats one error for a minute.
    """
    infos, measured, truth = values(bag)
    stamps = np.array([t.stamp_ns for t in truth])
    moving = np.array([np.hypot(*t.linear_velocity[:2]) for t in truth]) > 0.1
    known = {info.rsu_id: info for info in infos}
    rows: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for m in measured:
        last = int(np.searchsorted(stamps, m.stamp_ns, side="right")) - 1
        if last >= 0 and m.stamp_ns <= stamps[-1] and moving[last]:
            info = known[m.rsu_id]
            ray = interpolated(truth, m.stamp_ns) - info.position
            x, y, z = Rotation.from_quat(info.quaternion).inv().apply(ray)
            azimuth = math.remainder(m.azimuth_rad - math.atan2(y, x), math.tau)
            elevation = m.elevation_rad - math.atan2(z, math.hypot(x, y))
            rows[m.rsu_id].append((azimuth, elevation, m.range_m - float(np.linalg.norm(ray))))
    return {rsu_id: np.array(errors) for rsu_id, errors in rows.items()}


@pytest.mark.parametrize(
    ("run", "beacons", "corners"),
    [
        ("uc1_run1", 7949, 16),
        ("uc1_run2", 8436, 16),
        ("uc2_run1", 4966, 10),
        ("uc3_run1", 42365, 16),
    ],
)
def test_real_ble(tmp_path: Path, run: str, beacons: int, corners: int) -> None:
    folder = DATA / "ble_aoa"
    if not folder.is_dir():
        pytest.skip(f"no recording in {folder}; set NETPOS_DATA")
    counts = import_ble_aoa(folder, tmp_path / "bag", run=run)
    lines = (folder / f"truth_{run}.csv").read_text().split()
    assert len(lines) == corners
    span_ms = int(lines[-1].split(",")[0]) - int(lines[0].split(",")[0])
    assert counts == {
        "/rsu/info": 4,
        "/rsu/measurements": beacons,
        "/vue_1/ground_truth": span_ms // 100 + 1,
    }
    for error in residuals(tmp_path / "bag").values():
        azimuth, elevation = np.degrees(error[:, 0]), np.degrees(error[:, 1])
        assert abs(azimuth.mean()) < 7
        assert azimuth.std() < 15
        assert abs(elevation.mean()) < 8  # with the sign turned: 29 to 41 deg
        assert elevation.std() < 17


@pytest.mark.parametrize("case", ["LOS", "NLOS"])
def test_real_uwb(tmp_path: Path, case: str) -> None:
    folder = DATA / "uwb_car_anchors" / case
    if not folder.is_dir():
        pytest.skip(f"no recording in {folder}; set NETPOS_DATA")
    import_uwb_anchors(folder, tmp_path / "bag")
    _, measured, truth = values(tmp_path / "bag")
    lines = {f.stem: len(f.read_text().split("\n")) - 2 for f in folder.glob("A*.csv")}
    assert Counter(m.rsu_id for m in measured) == lines
    for error in residuals(tmp_path / "bag").values():
        assert abs(np.median(error[:, 2])) < 0.2
    moving = [t for t in truth if np.hypot(*t.linear_velocity[:2]) > 0.5]
    aside = [abs(math.atan2(t.linear_velocity[1], t.linear_velocity[0])) for t in moving]
    assert math.degrees(np.median(aside)) < 4
