"""Figures of other estimators beside ours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from netpos.evaluation.work import Work
from netpos.reproduction import columns as columns_module
from netpos.reproduction.columns import beside, in_columns, track_rows
from netpos.reproduction.experiment import Experiment
from netpos.reproduction.frame import Row, at_most
from netpos.reproduction.monte_carlo import Routes, Summary, monte_carlo

SHORT = Experiment(name="short", scenario="metis_madrid", changes=(("max_duration_s", 5.0),))


def _row(summary: Summary, *paper: float) -> Iterator[Row]:
    yield at_most("RMSE", "m", summary.rmse_m, *paper)
    if summary.experiment.estimator != "paper":
        yield at_most("level", "m", summary.level_m, 1e9)


def test_each_column_is_its_estimator_on_the_same_seeds() -> None:
    with Work(3, 1, 1) as work:
        columns = in_columns(work, SHORT)
        alone = {
            estimator: monte_carlo(work, replace(SHORT, estimator=estimator)).rmse_m
            for estimator in ("scenario", "paper", "defaults")
        }
    assert len(set(alone.values())) == 3
    rmse, level = beside(_row, columns, paper=(0.6,))
    assert (rmse.ours, rmse.baseline, rmse.defaults) == (
        alone["scenario"],
        alone["paper"],
        alone["defaults"],
    )
    assert (rmse.paper, rmse.ok) == (0.6, alone["scenario"] <= 0.6)
    assert level.baseline is None  # the paper's filter has none
    assert level.defaults is not None
    assert level.defaults != level.ours


def test_defaults_may_have_fewer_routes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns_module, "DEFAULTS_RUNS", 2)
    with Work(3, 1, 1) as work:
        columns = in_columns(work, SHORT)
    assert columns.defaults is not None
    assert columns.baseline is not None
    assert (columns.ours.runs, columns.baseline.runs, columns.defaults.runs) == (3, 3, 2)


def test_of_an_estimator_that_loses_all_only_the_loss_is_known() -> None:
    """Nobody finds the street from 5 km away."""
    far = replace(SHORT, changes=(*SHORT.changes, ("devices.0.initial_pose_sd_m", 5000.0)))
    with Work(2, 1, 1) as work:
        columns = in_columns(work, far, defaults=False)
    lost = Routes(runs=2, losses=2, astray=2, astray_at_bound=0.0, availability=0.0)
    assert columns.baseline == lost
    assert columns.defaults is None

    def make(summary: Summary, *paper: float) -> Iterator[Row]:
        yield from _row(summary, *paper)
        yield from track_rows(summary.experiment.name, summary.routes)

    rows = {row.name: row for row in beside(make, columns, paper=(0.6,))}
    assert rows["RMSE"].baseline is None
    assert rows["short: routes"].baseline == 2.0
    assert rows["short: tracks lost per route"].baseline == 1.0
    assert rows["short: availability"].baseline == 0.0
    assert rows["short: routes with an error above 5 m or lost"].baseline == 1.0
    assert rows["short: routes"].ours == 2.0
    assert all(row.defaults is None for row in rows.values())


@pytest.mark.parametrize(("astray", "ok"), [(0, True), (1, False)])
def test_no_route_may_go_astray_where_that_is_judged(astray: int, ok: bool) -> None:
    routes = Routes(
        runs=4, losses=2 * astray, astray=astray, astray_at_bound=0.2, availability=0.9
    )
    first, *rest = track_rows("x", routes, judged=True)
    assert (first.ours, first.ok) == (astray / 4, ok)
    assert [row.ours for row in rest] == [0.05, 4.0, astray / 2, 0.9]
    assert next(track_rows("x", routes)).ok is None
