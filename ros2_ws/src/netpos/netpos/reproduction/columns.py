"""One experiment by three estimators: ours, the paper's filter, ours with default parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from netpos.evaluation.work import Work
from netpos.reproduction.experiment import Estimator, Experiment
from netpos.reproduction.frame import Row, shown
from netpos.reproduction.monte_carlo import (
    NothingScoredError,
    Routes,
    Summary,
    monte_carlo,
)

DEFAULTS_RUNS = 200
"""At most as many routes are run with default parameters: one RSU then loses many tracks, and a
first fix takes longer than a route."""


Column = Summary | Routes | None


def track_rows(name: str, routes: Routes, *, judged: bool = False) -> Iterator[Row]:
    """Rows of lost tracks and large errors of an experiment; ``judged``: there must be none."""
    share = routes.astray / routes.runs
    ok = share == 0.0 if judged else None
    label = f"{name}: routes with an error above 5 m or lost"
    yield Row(name=label, unit="1", paper=None, ours=share, ok=ok)
    label = f"{name}: routes with an error above 5 m at the posterior bound, at least"
    yield shown(label, "1", routes.astray_at_bound / routes.runs)
    yield shown(f"{name}: routes", "1", float(routes.runs))
    yield shown(f"{name}: tracks lost per route", "1", routes.losses / routes.runs)
    yield shown(f"{name}: availability", "1", routes.availability)


@dataclass(frozen=True, slots=True, kw_only=True)
class Columns:
    """Summaries of one experiment by estimator; ``Routes`` where the estimator lost every track,
    None where a column is not wanted."""

    ours: Summary
    baseline: Column = None
    defaults: Column = None


def in_columns(
    work: Work,
    experiment: Experiment,
    *,
    baseline: bool = True,
    defaults: bool = True,
    series: bool = False,
) -> Columns:
    """Run an experiment with ours and the other estimators that are wanted, the same seeds for
    each; ``series`` as for ``monte_carlo``."""

    def other(wanted: bool, estimator: Estimator, runs: int) -> Column:
        if not wanted:
            return None
        changed = replace(experiment, estimator=estimator)
        try:
            return monte_carlo(work.with_runs(runs), changed, series=series)
        except NothingScoredError as error:
            return error.routes

    return Columns(
        ours=monte_carlo(work, experiment, series=series),
        baseline=other(baseline, "paper", work.runs),
        defaults=other(defaults, "defaults", min(work.runs, DEFAULTS_RUNS)),
    )


def beside(
    make: Callable[..., Iterable[Row]], *columns: Columns, paper: tuple[float, ...] = ()
) -> Iterator[Row]:
    """The rows that ``make`` gives of our summaries, one of each of ``columns``, and the figures
    of the ``paper``; the figures it gives of the other estimators go into the columns of the row.
    """
    names = [c.ours.experiment.name for c in columns]
    baseline = _figures(make, names, [c.baseline for c in columns], paper)
    defaults = _figures(make, names, [c.defaults for c in columns], paper)
    for row in make(*(c.ours for c in columns), *paper):
        yield row.beside(baseline=baseline.get(row.name), defaults=defaults.get(row.name))


def _figures(
    make: Callable[..., Iterable[Row]],
    names: list[str],
    columns: list[Column],
    paper: tuple[float, ...],
) -> dict[str, float | None]:
    """Figures by the name of their row; where a summary is missing only what became of the tracks
    of each."""
    if all(isinstance(one, Summary) for one in columns):
        return {row.name: row.ours for row in make(*columns, *paper)}
    lost = {name: one for name, one in zip(names, columns, strict=True) if isinstance(one, Routes)}
    return {row.name: row.ours for name in lost for row in track_rows(name, lost[name])}
