"""Real recordings: imported, replayed live and offline, as accurate as the baselines say.

The baselines are those of tests/baselines; `make baselines` rewrites them.
"""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from netpos.evaluation.guard import read_baselines
from runs import (
    MEASUREMENTS,
    ODOMETRY,
    TRACK_STATUS,
    assert_same,
    finish,
    graphs,
    netpos,
    script,
)

# 2-D RMSE [m] of a plain azimuth-only filter on the same runs
BLE_REFERENCE_M = {"uc1_run1": 1.04, "uc1_run2": 0.96, "uc2_run1": 0.69}
# 2-D RMSE [m] that the authors of the UWB recording report
UWB_REFERENCE_M = {"LOS": 1.04, "NLOS": 0.94}
# 2-D RMSE [m] of a least-squares fit of each epoch's 24 trolley ranges, without biases, and that
# fit's heading RMSE [deg], 7 deg of which are a mean that the truth shows at every heading.
TROLLEY_REFERENCE = (0.159, 9.4)
LIVE_RUN = "uc2_run1"  # the shortest
BASELINES = read_baselines(Path(__file__).parent / "baselines")


@dataclass(frozen=True)
class Replayed:
    """A recording as imported, replayed and scored."""

    imported: Path
    replayed: Path
    figures: dict[str, Any]


def scored(bag: Path) -> dict[str, Any]:
    figures = bag.with_suffix(".json")
    netpos("evaluate", bag, "--json", figures)
    vues: dict[str, dict[str, Any]] = json.loads(figures.read_text(encoding="utf-8"))["vues"]
    (only,) = vues.values()
    return only


def assert_keeps_baseline(name: str, figures: dict[str, Any]) -> None:
    """What the command line says lies within the guard's intervals."""
    kept = BASELINES[name].figures
    assert {"rmse_m", "nees_mean", "availability"} <= {*kept}
    for figure in ("rmse_m", "velocity_rmse_mps", "nees_mean", "availability"):
        if figure not in kept:  # too uncertain on this recording for an interval
            continue
        interval = kept[figure]
        assert interval is not None
        assert interval.holds(figures[figure]), (name, figure, figures[figure], interval)


def replayed(imported: Path) -> Replayed:
    out = imported.with_name(f"{imported.name}_offline")
    netpos("replay", imported, "--out", out)
    return Replayed(imported, out, scored(out))


def recording(data_folder: Path, *parts: str) -> Path:
    folder = data_folder.joinpath(*parts)
    if not folder.is_dir():
        pytest.skip(f"real recording is absent: no folder {folder}")
    return folder


@pytest.fixture(scope="module")
def ble(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Replayed]:
    source, folder = recording(data_folder, "ble_aoa"), tmp_path_factory.mktemp("ble")

    def prepare(run: str) -> Replayed:
        netpos("import", "ble-aoa", source, folder / run, "--run", run)
        return replayed(folder / run)

    with ThreadPoolExecutor(2) as pool:
        return dict(zip(BLE_REFERENCE_M, pool.map(prepare, BLE_REFERENCE_M), strict=True))


@pytest.mark.parametrize("run", BLE_REFERENCE_M)
def test_ble_angles(ble: dict[str, Replayed], run: str) -> None:
    figures = ble[run].figures
    assert figures["n"] > 3000
    assert_keeps_baseline(f"ble_{run}", figures)
    assert figures["rmse_m"] < BLE_REFERENCE_M[run]
    assert figures["clock_offset_sd_ns"] is None  # angles say nothing about a clock


def test_ble_angles_through_the_live_graph(ble: dict[str, Replayed]) -> None:
    """Ten times real time, about 1500 messages per second: the same bits, so the same figures."""
    offline = ble[LIVE_RUN]
    live = offline.imported.with_name(f"live_{LIVE_RUN}")
    with graphs(live.parent) as (graph,):
        finish(script(graph, "play_bag", offline.imported, live, "10"))
    topics = (MEASUREMENTS, ODOMETRY, TRACK_STATUS)
    assert_same(live, offline.replayed, topics)
    figures = scored(live)
    for name in ("n", "rmse_m", "p95_m", "nees_mean", "nis_mean", "rejected"):
        assert figures[name] == offline.figures[name], name


@pytest.mark.parametrize("view", UWB_REFERENCE_M)
def test_uwb_ranges(data_folder: Path, tmp_path: Path, view: str) -> None:
    source = recording(data_folder, "uwb_car_anchors", view)
    netpos("import", "uwb-anchors", source, tmp_path / view)
    figures = replayed(tmp_path / view).figures
    assert figures["n"] > 1000
    assert_keeps_baseline(f"uwb_{view.lower()}", figures)
    assert figures["rmse_m"] < UWB_REFERENCE_M[view]


def test_uwb_trolley(data_folder: Path, tmp_path: Path) -> None:
    source = recording(data_folder, "uwb_trolley")
    netpos("import", "uwb-trolley", source, tmp_path / "trolley")
    figures = replayed(tmp_path / "trolley").figures
    assert figures["n"] > 13_000
    assert_keeps_baseline("uwb_trolley", figures)
    assert figures["rmse_m"] < 0.5 * TROLLEY_REFERENCE[0]
    assert figures["heading_rmse_deg"] < 1.2 * TROLLEY_REFERENCE[1]
