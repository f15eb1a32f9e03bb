"""METIS Madrid from the command line: the figures others read, and that they are the guarded ones.

How accurate they must be is in tests/baselines/metis_madrid.json, over many seeds.
"""

from __future__ import annotations

import json
from pathlib import Path

from netpos.evaluation.guarded_runs import SEEDS, cases, track
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


def test_metis_offline_has_the_guarded_figures(tmp_path: Path) -> None:
    bag, figures = tmp_path / "metis", tmp_path / "metis.json"
    netpos("run", "metis_madrid", "--offline", "--bag", bag, "--seed", str(SEEDS[0]))
    netpos("evaluate", bag, "--json", figures)
    scored = json.loads(figures.read_text(encoding="utf-8"))
    assert {"vues", "requirements"} <= scored.keys()
    assert list(scored["vues"]) == ["vue_1"]
    vue = scored["vues"]["vue_1"]
    assert vue.keys() >= FIGURES
    assert scored["skip"] == 20
    (guarded,) = track(next(cases()["metis_madrid"].materials()))
    expected = guarded.figures.to_json()
    assert vue["n"] > 300
    for name in FIGURES - {"bound_ratio"}:
        assert vue[name] == expected[name], name
    assert vue["bound_ratio"] > 0.0
    assert vue["p50_m"] <= vue["p95_m"] <= vue["p99_m"] <= vue["max_m"]
    low, high = vue["nees_bounds"]
    assert vue["nees_consistent"] is (low <= vue["nees_mean"] <= high)
    assert scored["delivery"]["vue_1"]["missing"] == 0
