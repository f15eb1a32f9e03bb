"""METIS Madrid from the command line: accuracy, and the figures others read."""

from __future__ import annotations

import json
from pathlib import Path

from runs import netpos

FIGURES = {
    "n",
    "duration_s",
    "availability",
    "rmse_m",
    "mean_error_m",
    "p50_m",
    "p95_m",
    "p99_m",
    "max_m",
    "velocity_rmse_mps",
    "heading_rmse_deg",
    "clock_offset_sd_ns",
    "clock_offset_rmse_ns",
    "nees_mean",
    "nees_bounds",
    "nees_consistent",
    "nis_mean",
    "rejected",
    "bound_ratio",
}


def test_metis_offline_meets_its_figures(tmp_path: Path) -> None:
    bag, figures = tmp_path / "metis", tmp_path / "metis.json"
    netpos("run", "metis_madrid", "--offline", "--bag", bag)
    netpos("evaluate", bag, "--json", figures)
    scored = json.loads(figures.read_text(encoding="utf-8"))
    assert {"vues", "requirements"} <= scored.keys()
    assert list(scored["vues"]) == ["vue_1"]
    vue = scored["vues"]["vue_1"]
    assert vue.keys() >= FIGURES
    assert scored["skip"] == 20
    assert vue["n"] > 2000
    assert 0.0 < vue["rmse_m"] <= 0.6
    assert 0.0 < vue["clock_offset_sd_ns"] <= 4.0
    assert vue["availability"] >= 0.99
    assert vue["p50_m"] <= vue["p95_m"] <= vue["p99_m"] <= vue["max_m"]
    low, high = vue["nees_bounds"]
    assert vue["nees_consistent"] is (low <= vue["nees_mean"] <= high)
    assert scored["delivery"]["vue_1"]["missing"] == 0
