"""Rows of real recordings, and the script that writes them, on a small recording made up here."""

from __future__ import annotations

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
SPEED_MPS, RADIUS_M, SD_M, SECONDS = 1.0, 6.0, 0.05, 20


def position_of(seconds: np.ndarray) -> np.ndarray:
    """A circle: (n, 2) m."""
    turn = seconds * SPEED_MPS / RADIUS_M
    return RADIUS_M * np.column_stack([np.cos(turn), np.sin(turn)])


@pytest.fixture(scope="module", name="data")
def _data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a UWB recording named LOS, in the form of the public one."""
    folder = tmp_path_factory.mktemp("data")
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
    (row,) = content["rows"]
    assert row["name"] == "uwb_LOS"
    assert row["reference"] == 0.5
    figures = {"snapshot", "plain_ekf", "ours", "declared", "learned", "defaults"}
    assert set(row) == {"name", "reference", *figures, "wall_s"}
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
