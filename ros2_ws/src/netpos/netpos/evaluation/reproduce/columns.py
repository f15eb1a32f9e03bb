"""An experiment beside itself: ours, the paper's own filter, and ours with default parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from netpos.evaluation.reproduce.experiment import Estimator, Experiment
from netpos.evaluation.reproduce.frame import Row, Work
from netpos.evaluation.reproduce.monte_carlo import NothingScoredError, Summary, monte_carlo

DEFAULTS_RUNS = 200
"""At most as many routes are run with default parameters: one RSU then loses many tracks, and a
first fix takes longer than a route."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Columns:
    """Summaries of one experiment by estimator; None where a column is not wanted, or where the
    estimator lost every track."""

    ours: Summary
    baseline: Summary | None = None
    defaults: Summary | None = None


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

    def other(wanted: bool, estimator: Estimator, runs: int) -> Summary | None:
        if not wanted:
            return None
        changed = replace(experiment, estimator=estimator)
        try:
            return monte_carlo(work.with_runs(runs), changed, series=series)
        except NothingScoredError:
            return None

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
    baseline = _figures(make, [c.baseline for c in columns], paper)
    defaults = _figures(make, [c.defaults for c in columns], paper)
    for row in make(*(c.ours for c in columns), *paper):
        yield row.beside(baseline=baseline.get(row.name), defaults=defaults.get(row.name))


def _figures(
    make: Callable[..., Iterable[Row]], summaries: list[Summary | None], paper: tuple[float, ...]
) -> dict[str, float | None]:
    """Figures by the name of their row; none unless all summaries are there."""
    if None in summaries:
        return {}
    return {row.name: row.ours for row in make(*summaries, *paper)}
