"""Figures of other estimators beside ours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from netpos.evaluation.reproduce import columns as columns_module
from netpos.evaluation.reproduce.columns import Columns, beside, in_columns
from netpos.evaluation.reproduce.experiment import Experiment
from netpos.evaluation.reproduce.frame import Row, Work, at_most
from netpos.evaluation.reproduce.monte_carlo import NothingScoredError, Summary, monte_carlo

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


def test_an_estimator_that_loses_all_leaves_its_column_empty(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(work: Work, experiment: Experiment, **more: bool) -> Summary:
        if experiment.estimator == "paper":
            raise NothingScoredError("all lost")
        return monte_carlo(work, experiment, **more)

    monkeypatch.setattr(columns_module, "monte_carlo", fails)
    with Work(2, 1, 1) as work:
        columns = in_columns(work, SHORT, defaults=False)
    assert columns == Columns(ours=columns.ours)
    row, _ = beside(_row, columns, paper=(0.6,))
    assert (row.baseline, row.defaults) == (None, None)
