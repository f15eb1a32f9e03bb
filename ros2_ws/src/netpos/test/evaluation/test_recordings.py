"""Rows of real recordings, and the script that writes them, on a small recording made up here."""

from __future__ import annotations

import gzip
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from netpos.bags.importers import import_uwb_anchors
from netpos.bags.importers.uwb_anchors import TAG_HEIGHT_M, TRACKER
from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.recordings import baseline_figures, default_parameters
from netpos.evaluation.yardsticks import Space, observations_of_bag
from netpos.tracking.config import TrackerConfig

ROOT = Path(__file__).resolve().parents[5]
S = 1_000_000_000
ANCHORS = {"A3": (-8, -8, 2), "A5": (8, -8, 0.5), "A9": (8, 8, 2), "A12": (-8, 8, 0.5)}
STATIONS = np.array(
    [[60.0, 60.0, 10.0], [-60.0, 50.0, 10.0], [-50.0, -60.0, 8.0], [70.0, -60.0, 8.0]]
)
SPEED_MPS, RADIUS_M, SD_M, SECONDS = 1.0, 6.0, 0.05, 20


def position_of(seconds: np.ndarray) -> np.ndarray:
    """A circle: (n, 2) m."""
    turn = seconds * SPEED_MPS / RADIUS_M
    return RADIUS_M * np.column_stack([np.cos(turn), np.sin(turn)])


def write_street(folder: Path) -> None:
    """Two points among four stations, thirty draws of time differences and azimuths each, in the
    form of the public set: the first station of a draw is the one to count from."""
    folder.mkdir()
    rng = np.random.default_rng(3)
    header = "BS_x,BS_y,BS_z,tdoa,aoa_az,aoa_el,UE_x,UE_y,UE_z,timestamp"
    lines = [header]
    for point in np.array([[0.0, 0.0, 0.0], [15.0, 4.0, 0.0]]):
        for draw in range(1, 31):
            away = STATIONS - point
            late = np.linalg.norm(away, axis=1) + rng.normal(0.0, 0.5, 4)
            azimuth = np.arctan2(away[:, 1], away[:, 0]) + rng.normal(0.0, 0.02, 4)
            tdoa = ["NaN", *(late[1:] - late[0])]
            for site, difference, angle in zip(STATIONS, tdoa, azimuth, strict=True):
                values = [*site, difference, angle, 0.0, *point, draw]
                lines.append(",".join(map(str, values)))
    with gzip.open(folder / "trajectory_100MHz.csv.gz", "wt") as stream:
        stream.write("\n".join(lines) + "\n")


@pytest.fixture(scope="module", name="data")
def _data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A UWB recording named LOS and a street with 5G stations, in the form of the public ones."""
    folder = tmp_path_factory.mktemp("data")
    write_street(folder / "5g_raytraced")
    los = folder / "uwb_car_anchors" / "LOS"
    los.mkdir(parents=True)
    rng = np.random.default_rng(17)
    for name, site in ANCHORS.items():
        times = np.arange(SECONDS * 10) * 0.1 + 1.0
        level = position_of(times) - site[:2]
        length = np.sqrt((level**2).sum(axis=1) + (TAG_HEIGHT_M - site[2]) ** 2)
        length += SD_M * rng.standard_normal(len(length))
        rows = [
            f"1,{round(t * S)},{name[1:]},{site[0]},{site[1]},{site[2]},{d},-79,-80"
            for t, d in zip(times, length, strict=True)
        ]
        (los / f"{name}.csv").write_text("\n".join(["header", *rows]) + "\n")
    times = np.arange(SECONDS * 8 + 1) / 8 + 1.0
    rows = [
        f"{t * S:.0f},{x},{y},0.0,0.0" for t, (x, y) in zip(times, position_of(times), strict=True)
    ]
    (los / "trajectory.csv").write_text("\n".join(["timestamp,x,y,z,heading", *rows]) + "\n")
    (los / "authors_results.txt").write_text(
        "LS RMSE_2d: 1.5\nESKF RMSE: 0.2\nESKF RMSE_2d: 0.5\n"
    )
    return folder


@pytest.fixture(scope="module", name="bag")
def _bag(data: Path) -> Path:
    import_uwb_anchors(data / "uwb_car_anchors" / "LOS", data / "bag")
    return data / "bag"


def test_baselines_are_scored_at_the_epochs_that_count_and_at_their_own(bag: Path) -> None:
    """Against a truth that is wrong by 3 m in its second half: only what is counted knows."""
    seen = observations_of_bag(bag, range_sd_m=0.2)
    stamps = np.unique(seen.stamp_ns)
    true = position_of(stamps / S)
    true[len(stamps) // 2 :] += [3.0, 0.0]
    n = len(stamps)
    truth = Trajectory(
        stamp_ns=stamps,
        position=np.column_stack([true, np.full(n, TAG_HEIGHT_M)]),
        velocity=np.zeros((n, 3)),
        heading=np.zeros(n),
        position_cov=np.zeros((n, 3, 3)),
    )
    counted = stamps[20 : n // 2]
    rows = baseline_figures(seen, Space(height_m=TAG_HEIGHT_M), truth, counted)
    for name, most in (("snapshot", 0.7), ("plain_ekf", 0.2)):  # half a second of walking is 0.5 m
        figures = rows[name]
        assert figures["n"] == len(counted), name
        assert figures["rmse_m"] < most, name
        # 20 of 200 epochs do not count; 3 m in 100 of the 180 left
        assert figures["own"]["rmse_m"] == pytest.approx(3 * math.sqrt(100 / 180), abs=0.4), name
        assert figures["availability"] > 0.95
        assert figures["time_to_first_fix_s"] < 0.5
    assert rows["plain_ekf"]["nis_expected"] == pytest.approx(4.0)
    assert rows["snapshot"]["nis_mean"] is None


def test_default_parameters_leave_the_facts(bag: Path) -> None:
    changed = default_parameters(bag)
    assert set(changed) == set(TRACKER) - {"device_height_m"}
    assert changed["accel_density_mps2_sqrthz"] == TrackerConfig().accel_density_mps2_sqrthz


@pytest.mark.timeout(900)  # compiles kernels where none are kept
def test_the_script_writes_one_row_per_recording(data: Path, tmp_path: Path) -> None:
    out, file = tmp_path / "bags", tmp_path / "new" / "rows.json"
    script = [sys.executable, str(ROOT / "scripts" / "real_data.py")]
    options = ["--data", str(data), "--json", str(file), "--out", str(out)]
    run = subprocess.run([*script, *options], capture_output=True, text=True, check=True)
    content = json.loads(file.read_text())
    row, street = content["rows"]
    assert row["name"] == "uwb_LOS"
    assert street["name"] == "5g_raytraced street"
    for name in ("snapshot", "plain_ekf", "ours", "declared", "learned", "defaults"):
        assert street[name]["n"] > 50, name  # of 60, two devices together
        assert 0.0 < street[name]["rmse_m"] < 1.0, name
    assert street["ours"]["rmse_m"] < street["snapshot"]["rmse_m"]
    assert street["ours"]["lost_tracks"] == 0
    assert street["ours"]["unscored_s"] < 10.0
    assert street["snapshot"]["unscored_s"] is None  # the time between the devices is nobody's
    assert row["reference"] == 0.5
    figures = {"snapshot", "plain_ekf", "ours", "declared", "learned", "defaults"}
    assert set(row) == {"name", "reference", "truth_time", *figures, "wall_s"}
    assert row["truth_time"] is None  # its clock is that of the ranges
    for name in figures - {"snapshot"}:
        assert 0.0 < row[name]["rmse_m"] < 0.3, name
        assert row[name]["nis_expected"] > 0.9
        low, high = row[name]["nees_bounds"]
        assert low < 2.0 < high
    # a window of 1 s on a circle at 1 m/s: its middle is 0.45 m behind
    assert row["snapshot"]["rmse_m"] == pytest.approx(0.45, abs=0.1)
    assert row["ours"]["n"] == row["plain_ekf"]["n"]
    assert "ble_uc3_run1" in content["absent"]
    assert "uwb_tdoa" in content["absent"]
    assert "| uwb_LOS | 0.500 |" in run.stdout
    assert (out / "uwb_LOS" / "metadata.yaml").exists()
    again = subprocess.run([*script, *options], capture_output=True, text=True, check=False)
    assert again.returncode == 2
    assert "exists" in again.stderr


def test_the_script_refuses_a_folder_without_recordings(tmp_path: Path) -> None:
    script = [sys.executable, str(ROOT / "scripts" / "real_data.py")]
    options = ["--data", str(tmp_path), "--json", str(tmp_path / "rows.json")]
    run = subprocess.run([*script, *options], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert "no recording" in run.stderr
    assert not (tmp_path / "rows.json").exists()
