"""The car recording: a made-up one read back, broken ones refused, the real one where it is."""

from __future__ import annotations

import math
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from netpos.bags import BagError, BagReader, codec
from netpos.bags.importers.car_imu_rtk import MOUNT as CAR
from netpos.bags.importers.car_imu_rtk import load_car_drive, truth_of
from netpos.bags.importers.common import recordings
from netpos.scenario.recorded_drive import import_car_drive, station_drive
from scipy.spatial.transform import Rotation

DATA = Path(os.environ.get("NETPOS_DATA", Path(__file__).parents[6] / "shared" / "data"))
START_S = 1_752_003_261
MOUNT = Rotation.from_euler("ZYX", [185.35, -6.79, 180.0], degrees=True)
SECONDS = 20


def write(folder: Path, *, imu: str | None = None, pos: str | None = None) -> Path:
    """A car that drives north-east at 10 m/s and climbs 1 m/s, turning its nose by 0.1 rad/s to
    the left; level."""
    folder.mkdir()
    flip = np.array([1.0, -1.0, -1.0])  # forward-left-up and forward-right-down
    force = MOUNT.apply(flip * [0.5, 0.2, 9.80665]) / 9.80665
    rate = np.degrees(MOUNT.apply(flip * [0.0, 0.0, 0.1]))
    row = ",".join(f"{v:.9f}" for v in (*force, *rate))
    lines = [f"{row},{1000 + 10 * i}" for i in range(SECONDS * 100 + 1)]
    (folder / "imu_7.csv").write_text("\n".join(lines) + "\n0.1,0.2" if imu is None else imu)
    tag = b"TIMETAG RTKLIB".ljust(60, b"\0") + struct.pack("<I", 5)
    tag += struct.pack("<Id", START_S, 0.25) + struct.pack("<II", 0, 1)
    (folder / "imu_7.csv.tag").write_bytes(tag + struct.pack("<II", SECONDS * 1000, 99))
    rows = ["%  GPST latitude longitude height Q"]
    for i in range(SECONDS * 4):
        t = i / 4
        east = north = 10.0 * t / math.sqrt(2)
        latitude = 40.0 + math.degrees(north / 6_360_900.0)  # meridian radius at 40 deg, 1600 m
        longitude = -105.0 + math.degrees(east / (6_388_785.0 * math.cos(math.radians(40.0))))
        quality = 2 if i == 5 else 1
        stamp = f"2025/07/08 19:34:{21 + i // 4}.{250 * (i % 4):03d}"
        rows.append(f"{stamp} {latitude:.9f} {longitude:.9f} {1600 + t:.4f} {quality} 21 0 0 0")
    (folder / "gnss_7_sf.pos").write_text("\n".join(rows) if pos is None else pos)
    return folder


def test_a_recording_read_back(tmp_path: Path) -> None:
    drive = load_car_drive(write(tmp_path / "run"))
    assert len(drive.imu_ns) == SECONDS * 100 + 1  # all but the cut line
    assert drive.imu_ns[0] == START_S * 10**9 + round((0.25 + CAR.clock_offset_s) * 1e9)
    assert drive.imu_ns[-1] - drive.imu_ns[0] == SECONDS * 10**9
    np.testing.assert_allclose(drive.rates, [[0, 0, 0.1, 0.5, 0.2, 9.80665]] * len(drive.rates),
                               atol=1e-6)  # fmt: skip
    assert len(drive.rtk_ns) == SECONDS * 4 - 1  # one was not fixed
    assert drive.rtk_ns[0] == START_S * 10**9
    t = (drive.rtk_ns - drive.rtk_ns[0]) / 1e9
    way = np.column_stack([10 * t / math.sqrt(2), 10 * t / math.sqrt(2), t])
    np.testing.assert_allclose(drive.antenna, way, atol=0.15)
    assert drive.tracker["gravity_mps2"] == pytest.approx(9.7969, abs=5e-4)
    truth = truth_of(drive, "vue_1")
    assert Rotation.from_quat(truth[9].quaternion).as_euler("ZYX")[0] == pytest.approx(
        math.pi / 4, abs=0.02
    )
    np.testing.assert_allclose(truth[9].linear_velocity, [10.0, 0.0, 1.0], atol=0.2)


def test_an_import_is_a_bag_of_stations_imu_and_truth(tmp_path: Path) -> None:
    folder = write(tmp_path / "run")
    counts = import_car_drive(folder, tmp_path / "bag", fewest=2, nearest=2, seed=4)
    drive = load_car_drive(folder)
    simulated = station_drive(drive, fewest=2, nearest=2, seed=4)
    assert counts == {
        "/rsu/info": len(simulated.stations),
        "/rsu/measurements": 2 * len(simulated.stamps_ns),
        "/vue_1/imu": len(drive.imu_ns),
        "/vue_1/ground_truth": len(drive.rtk_ns),
    }
    with BagReader(tmp_path / "bag") as bag:
        assert "simulated stations 2-2, seed 4" in bag.metadata["source"]
        measured = [
            codec().measurement_from_msg(entry.message)
            for entry in bag.messages(["/rsu/measurements"])
        ]
    assert {m.stamp_ns for m in measured} == set(simulated.stamps_ns.tolist())
    assert all(m.lever_arm == pytest.approx((0.0, 0.05, 0.0)) for m in measured)
    with pytest.raises(FileExistsError):
        import_car_drive(folder, tmp_path / "bag")


@pytest.mark.parametrize(
    ("parts", "complaint"),
    [
        ({"imu": "1,2,3,4,5,6,7\nx,2,3,4,5,6,8\n1,2,3,4,5,6,9\n1,2,3,4,5,6,10"}, "line 2"),
        ({"imu": "1,2,3,4,5,6,9\n1,2,3,4,5,6,8\n1,2,3,4,5,6,10"}, "ticks must increase"),
        ({"imu": "1,2,3,4,5,6,9\n1,2,3,4,5,6,nan\n1,2,3,4,5,6,10"}, "line 2"),
        ({"pos": "2025/07/08 19:34:18.499 40.0 north 1600 1"}, "line 1: not an RTKLIB"),
        ({"pos": "% nothing"}, "two fixed solutions"),
    ],
)
def test_broken_recordings_are_refused(
    tmp_path: Path, parts: dict[str, str], complaint: str
) -> None:
    with pytest.raises(BagError, match=complaint):
        load_car_drive(write(tmp_path / "run", **parts))


def test_missing_parts_are_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"one imu_RUN\.csv, it has 0"):
        load_car_drive(tmp_path)
    folder = write(tmp_path / "run")
    (folder / "imu_7.csv.tag").write_bytes(b"nothing")
    with pytest.raises(BagError, match="no RTKLIB time tag"):
        load_car_drive(folder)
    (folder / "imu_7.csv.tag").unlink()
    with pytest.raises(BagError, match="no absolute time"):
        load_car_drive(folder)


@pytest.mark.parametrize(("fewest", "nearest"), [(0, 2), (3, 2)])
def test_numbers_of_stations_are_checked(tmp_path: Path, fewest: int, nearest: int) -> None:
    drive = load_car_drive(write(tmp_path / "run"))
    with pytest.raises(ValueError, match="1 <= fewest <= nearest"):
        station_drive(drive, fewest=fewest, nearest=nearest, seed=1)


def test_the_real_recording() -> None:
    """Level at rest, and the gyro turns as the course of RTK does."""
    folder = DATA / "car_imu_rtk"
    if not folder.is_dir():
        pytest.skip(f"no recording in {folder}; set NETPOS_DATA")
    drive = load_car_drive(folder)
    rest = drive.imu_ns < drive.imu_ns[0] + 30 * 10**9
    force = drive.rates[rest, 3:].mean(axis=0)
    np.testing.assert_allclose(force, [0.0, -0.19, 9.93], atol=0.02)
    t = (drive.rtk_ns - drive.rtk_ns[0]) / 1e9
    velocity = np.gradient(drive.antenna, t, axis=0)
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > 3.0
    course = np.gradient(
        np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0])), t[moving]
    )
    turned = np.cumsum(drive.rates[:, 2] * 0.01)
    imu_s = (drive.imu_ns - drive.rtk_ns[0]) / 1e9
    rate = (
        np.interp(t[moving] + 0.25, imu_s, turned) - np.interp(t[moving] - 0.25, imu_s, turned)
    ) / 0.5
    steady = np.abs(course) < 1.0
    assert np.corrcoef(rate[steady], course[steady])[0, 1] > 0.98
    way = np.linalg.norm(np.diff(drive.antenna[:, :2], axis=0), axis=1).sum()
    assert way == pytest.approx(4050.0, abs=20.0)


def test_recordings_are_found_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "shared" / "data" / "a").mkdir(parents=True)
    monkeypatch.delenv("NETPOS_DATA", raising=False)
    monkeypatch.setenv("NETPOS_ROOT", str(tmp_path / "project"))
    assert recordings("a") == tmp_path / "shared" / "data" / "a"
    monkeypatch.setenv("NETPOS_DATA", str(tmp_path))
    assert recordings("a") is None
    assert recordings("shared") == tmp_path / "shared"
