"""The reproduction as a whole, on few seeds: rows, verdicts, pictures; swaps are noticed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from netpos.evaluation.work import Work
from netpos.reproduction import PAPERS
from netpos.reproduction.dvornikov2017 import defaults as network_defaults
from netpos.reproduction.dvornikov2017 import paper
from netpos.reproduction.dvornikov2017.claims import Sides, claims
from netpos.reproduction.dvornikov2017.crossing import run_crossing
from netpos.reproduction.dvornikov2017.defaults import run_defaults
from netpos.reproduction.dvornikov2017.stages import stages_of
from netpos.reproduction.dvornikov2017.summary import LOST_M, NetworkSummary
from netpos.reproduction.frame import Outcome


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    """Shorter runs of everything."""
    with Work(2, 5000, 1) as work:
        return paper.reproduce(work)


def test_it_is_known() -> None:
    assert PAPERS["dvornikov2017"] == paper.__name__


def test_rows_answer_the_targets(outcome: Outcome) -> None:
    rows = {row.name: row for row in outcome.rows}
    assert len(rows) == len(outcome.rows)
    limit = rows["paper's motion, fused, x: RMSE at the 15th second"]
    assert (limit.paper, limit.ok) == (5.0, True)
    assert None not in (limit.baseline, limit.defaults)
    ratio = rows["paper's motion, gain floor: RMSE fused over the better network"]
    assert ratio.ours is not None
    assert 0.8 < ratio.ours < 1.1
    swaps = rows["5 objects crossing in all directions: runs without an identity swap"]
    assert (swaps.paper, swaps.ours) == (0.99, 1.0)


def test_every_claim_is_judged_for_every_estimator_and_coordinate(outcome: Outcome) -> None:
    for name in ("fused", "wimax", "wifi"):
        for axis in "xy":
            claim_rows = [
                r for r in outcome.rows if r.name.startswith(f"paper's motion, {name}, {axis}: ")
            ]
            judged = {row.name.split(": ", 1)[1]: row for row in claim_rows if row.ok is not None}
            assert [row.paper for row in judged.values()] == [5.0, 15.0, 5.0, 5.0, 10.0]
            for row in judged.values():
                assert row.ok is (row.ours is not None and row.ours <= (row.paper or 0.0))


def test_the_column_of_the_paper_is_its_better_network(outcome: Outcome) -> None:
    """... and the same filter where a network has a row of its own."""
    rows = {row.name: row for row in outcome.rows}
    what = "x: RMSE in steady state"
    fused, wimax, wifi = (rows[f"paper's motion, {n}, {what}"] for n in ("fused", "wimax", "wifi"))
    assert fused.baseline == wimax.ours == wimax.baseline
    assert wifi.baseline == wifi.ours
    assert fused.ours != fused.baseline
    assert wimax.defaults == pytest.approx(2.1, abs=0.3)
    assert wifi.defaults is None  # fixes of 10 m never start a track by default


def test_gains_rest_where_the_paper_has_them(outcome: Outcome) -> None:
    gains = [row for row in outcome.rows if ": gain k" in row.name]
    assert len(gains) == 8
    assert all(row.ok for row in gains)
    first = next(row for row in gains if row.name.startswith("paper's motion, wifi: gain k11 of"))
    assert first.ours == pytest.approx(1000 / 1100, rel=1e-6)


def test_pictures(outcome: Outcome, tmp_path: Path) -> None:
    paths = outcome.draw(tmp_path)
    assert {path.stem for path in paths} == {
        "fig6_gains",
        "fig7_errors",
        "tertiary",
        "gain_floor",
        "crossing",
    }
    assert all(path.stat().st_size > 10_000 for path in paths)


def test_forgetting_swaps_where_memory_does_not() -> None:
    """The count of swaps can rise: the same seeds, without memory."""
    kept, lost = (
        [run_crossing(entry.case, seed) for seed in range(5000, 5006)]
        for entry in paper.CROSSINGS[1:]
    )
    assert not any(run.swapped or run.renamed for run in kept)
    assert any(run.swapped for run in lost)
    assert all(run.fused_share > 0.5 for run in kept)


def test_figures_of_a_summary_by_hand() -> None:
    errors = np.array([[[3.0, 4.0], [0.0, 2.0]], [[0.0, 0.0], [6.0, 0.0]]])
    summary = NetworkSummary(
        setting=replace(paper.PAPER),
        time_s=np.array([0.0, 10.0]),
        errors={"a": errors},
        covs={"a": np.array([np.eye(2), 4.0 * np.eye(2)])},
    )
    assert summary.rmse_m("a") == pytest.approx(np.sqrt((25 + 4 + 0 + 36) / 4))
    assert summary.rmse_m("a", 5.0) == pytest.approx(np.sqrt(20.0))
    assert summary.rmse_m("a", 0.0, 10.0) == pytest.approx(np.sqrt(12.5))
    assert summary.axis_rmse_m("a", 0, 5.0) == pytest.approx(np.sqrt(18.0))
    assert summary.axis_rmse_m("a", 1, 5.0) == pytest.approx(np.sqrt(2.0))
    assert summary.axis_sd_m("a", 1, 5.0) == 2.0
    assert summary.axis_share_within("a", 0, 5.0, 5.0) == 0.5
    assert summary.axis_largest_m("a", 0, 5.0) == 6.0
    assert summary.axis_largest_m("a", 1, 0.0) == 4.0
    assert summary.share_of_runs_above("a", 5.5, 0.0) == 0.5
    assert (summary.lost("a"), summary.share_without("a")) == (0, 0.0)
    np.testing.assert_allclose(summary.nees("a"), [[25.0, 1.0], [0.0, 9.0]])
    test = summary.nees_test("a", 5.0)
    assert test is not None
    assert test.mean == 5.0
    half_width = test.bounds[1] - 2.0  # two runs: t of 97.5 % with one degree, standard error 4
    assert half_width == pytest.approx(12.7062 * 4.0, rel=1e-5)


def test_a_figure_settles_where_it_stays() -> None:
    """RMSE of x over two runs: 6, 2, 6, 3, 3 m."""
    errors = np.zeros((2, 5, 2))
    errors[..., 0] = [6.0, 2.0, 6.0, 3.0, 3.0]
    summary = NetworkSummary(
        setting=paper.PAPER,
        time_s=np.arange(5.0),
        errors={"a": errors},
        covs={"a": np.tile(np.eye(2), (5, 1, 1))},
    )
    assert summary.axis_settled_s("a", 0, 5.0) == 3.0
    assert summary.axis_settled_s("a", 0, 7.0) == 0.0
    assert np.isnan(summary.axis_settled_s("a", 0, 2.5))


def test_what_is_missing_is_no_error_but_lost() -> None:
    errors = np.array([[[3.0, 4.0], [np.nan, np.nan]], [[0.0, 0.0], [LOST_M + 1.0, 0.0]]])
    summary = NetworkSummary(
        setting=paper.PAPER,
        time_s=np.array([0.0, 10.0]),
        errors={"a": errors, "none": np.full((2, 2, 2), np.nan)},
        covs={"a": np.full((2, 2, 2, 2), np.eye(2)), "none": np.full((2, 2, 2, 2), np.nan)},
    )
    assert summary.rmse_m("a", 0.0, 10.0) == pytest.approx(np.sqrt(12.5))
    assert summary.rmse_m("a", 5.0) == pytest.approx(LOST_M + 1.0)
    assert (summary.lost("a"), summary.lost("none")) == (2, 2)
    assert (summary.share_without("a"), summary.share_without("none")) == (0.25, 1.0)
    assert summary.share_of_runs_above("a", 4.9, 0.0) == 1.0
    assert np.isnan(summary.rmse_m("none"))
    assert np.isnan(summary.axis_largest_m("none", 0, 0.0))
    assert summary.nees_test("none") is None
    test = summary.nees_test("a", 0.0, 10.0)
    assert test is not None
    assert test.mean == 12.5


def test_an_estimator_without_estimates_has_an_empty_column() -> None:
    """... and misses what is demanded of it."""
    good = NetworkSummary(
        setting=paper.PAPER,
        time_s=np.array([20.0, 70.0]),
        errors={n: np.ones((2, 2, 2)) for n in ("wimax", "wifi", "split_ci")},
        covs=dict.fromkeys(("wimax", "wifi", "split_ci"), np.tile(np.eye(2), (2, 1, 1))),
    )
    none = replace(good, errors={n: np.full((2, 2, 2), np.nan) for n in good.errors})
    sides = Sides(ours=good, paper=good, defaults=none)
    rows = {row.name: row for row in claims(sides)}
    row = rows["paper's motion, fused, x: RMSE in steady state"]
    assert (row.baseline, row.ours, row.defaults, row.ok) == (1.0, 1.0, None, True)
    rows = {row.name: row for row in claims(Sides(ours=none, paper=good, defaults=good))}
    row = rows["paper's motion, fused, x: RMSE in steady state"]
    assert (row.ours, row.ok, row.defaults) == (None, False, 1.0)
    assert (
        rows[f"paper's motion, fused: runs lost (no estimate at the end, or {LOST_M:g} m off)"].ok
        is False
    )


def test_default_networks_hear_the_fixes_the_filters_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once the start is forgotten, a tracker's track is that of the stages with the same process
    noise, which know of no manoeuvre; the fused track is the only network's that has one."""
    steady = replace(network_defaults.TRACKER, manoeuvre_speed_sd_mps=0.0)
    monkeypatch.setattr(network_defaults, "TRACKER", steady)
    setting = replace(paper.COMMON_NOISE, duration_s=30.0)
    estimates = run_defaults(setting, 5000)
    like_defaults = replace(
        setting, tracker=replace(paper.JERKY, jerk_density=1.0), start_var=25.0
    )
    expected = stages_of(like_defaults).errors(5000)["wimax"]
    late = stages_of(like_defaults).time_s > 20.0
    np.testing.assert_allclose(estimates["wimax"][0][late], expected[late], atol=0.05)
    assert np.isnan(estimates["wifi"][0]).all()
    np.testing.assert_allclose(
        estimates["split_ci"][0][late], estimates["wimax"][0][late], atol=1e-9
    )
