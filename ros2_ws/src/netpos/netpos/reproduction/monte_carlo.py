"""Many seeds of an experiment; only sums are kept."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.estimation.compile import kernel
from netpos.estimation.level.protection import gaussian_tail
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.state import POSITION, X
from netpos.evaluation.consistency import MeanTest, nees_over_runs
from netpos.evaluation.metrics import MIN_SPEED_MPS, NS, SKIP_EPOCHS
from netpos.evaluation.work import Work
from netpos.messages.values import Array
from netpos.reproduction.experiment import Experiment, Track, setup_of

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

DIVERGED_M = 5.0
LEVEL_MAX_M = 1000.0  # counted of a protection level: where a direction is open it has no end
BIN_M = 0.002  # of the histogram of errors
BINS = 10_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """Sums over the scored estimates of one run; errors in m, ns and rad. epochs: as many as would
    be scored were there always a track; losses: how often the track was lost; bound_above:
    probability that an error with the covariance of the posterior bound is above ``DIVERGED_M`` in
    the epoch in which the bound is largest."""

    n: int
    epochs: int
    error2: float
    error: float
    error_max: float
    clock: float
    clock2: float
    heading2: float
    heading_n: int
    nees: float
    nis: float
    dof: float
    exceeded: int
    level: float
    bound2: float
    rate_hz: float
    ready_s: float | None
    speed_max: float
    losses: int
    bound_above: float

    @property
    def astray(self) -> bool:
        """An error above ``DIVERGED_M`` at some time, or no track."""
        return self.losses > 0 or self.error_max > DIVERGED_M


class Routes(NamedTuple):
    """What became of the tracks of an experiment.

    runs; losses: tracks lost in all of them; astray: runs with a loss or an error above 5 m;
    astray_at_bound: how many of these an unbiased filter with the posterior bound would have, on
    average and at least; availability: share of the epochs to be scored that have a track.
    """

    runs: int
    losses: int
    astray: int
    astray_at_bound: float
    availability: float

    @classmethod
    def of(cls, tallies: list[Tally]) -> Routes:
        """Of the runs of an experiment."""
        return cls(
            runs=len(tallies),
            losses=sum(t.losses for t in tallies),
            astray=sum(t.astray for t in tallies),
            astray_at_bound=sum(t.bound_above for t in tallies),
            availability=sum(t.n for t in tallies) / max(sum(t.epochs for t in tallies), 1),
        )


class NothingScoredError(ValueError):
    """No run of an experiment has an estimate that counts; ``routes`` says what became of them."""

    def __init__(self, message: str, routes: Routes) -> None:
        super().__init__(message)
        self.routes = routes


@kernel
def _sums(
    mean: Array,
    cov: Array,
    truth: Array,
    bound: Array,
    tracked: Flags,
    out: Array,
    histogram: Ints,
) -> None:
    """Add to out (10,), over the epochs ``tracked``: error^2, error, clock error and its square
    [ns], heading error^2, their number, bound^2, largest error, NEES, number of epochs; count
    errors in the histogram."""
    to_ns = 1e9 / SPEED_OF_LIGHT_MPS
    for i in range(mean.shape[0]):
        if not tracked[i]:
            continue
        x, y = mean[i, X.PX] - truth[i, X.PX], mean[i, X.PY] - truth[i, X.PY]
        square = x * x + y * y
        error = np.sqrt(square)
        clock = to_ns * (mean[i, X.CLOCK] - truth[i, X.CLOCK])
        out[0] += square
        out[1] += error
        out[2] += clock
        out[3] += clock * clock
        vx, vy = truth[i, X.VX], truth[i, X.VY]
        if vx * vx + vy * vy > MIN_SPEED_MPS**2:
            wx, wy = mean[i, X.VX], mean[i, X.VY]
            turn = np.arctan2(vx * wy - vy * wx, vx * wx + vy * wy)
            out[4] += turn * turn
            out[5] += 1.0
        out[6] += bound[i, 0, 0] + bound[i, 1, 1]
        out[7] = max(out[7], error)
        a, b, c = cov[i, X.PX, X.PX], cov[i, X.PX, X.PY], cov[i, X.PY, X.PY]
        out[8] += (c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b)
        out[9] += 1.0
        histogram[min(int(error / BIN_M), BINS)] += 1


def tally(track: Track, position_sd_max_m: float, histogram: Ints, skip: int) -> Tally:
    """Sums of one run without its first ``skip`` epochs; errors are counted in ``histogram``
    (BINS + 1,). Ready: position sd (largest axis) at most ``position_sd_max_m``."""
    scored = track.tracked.copy()
    scored[:skip] = False
    out = np.zeros(10)
    _sums(track.mean, track.cov, track.truth, track.bound, scored, out, histogram)
    error2, error, clock, clock2, heading2, heading_n, bound2, error_max, nees, n = out.tolist()
    a, b, c = track.cov[:, X.PX, X.PX], track.cov[:, X.PX, X.PY], track.cov[:, X.PY, X.PY]
    largest = (a + c) / 2 + np.hypot((a - c) / 2, b)
    ready = np.flatnonzero(largest <= position_sd_max_m**2)
    elapsed = (track.stamps_ns - track.stamps_ns[0]) / NS
    speed = np.hypot(track.truth[:, X.VX], track.truth[:, X.VY])
    level = track.level[scored]
    bound = track.bound[scored, POSITION, POSITION]
    return Tally(
        n=int(n),
        epochs=max(scored.size - skip, 0),
        error2=error2,
        error=error,
        error_max=error_max,
        clock=clock,
        clock2=clock2,
        heading2=heading2,
        heading_n=int(heading_n),
        nees=nees,
        nis=float(track.nis[scored].sum()),
        dof=float(track.dof[scored].sum()),
        exceeded=int((track.error_m[scored] > level).sum()),
        level=float(np.minimum(level, LEVEL_MAX_M).sum()),
        bound2=bound2,
        rate_hz=float(max(track.tracked.sum() - 1, 0) / elapsed[-1]),
        ready_s=float(elapsed[ready[0]]) if ready.size else None,
        speed_max=float(speed.max()),
        losses=track.losses,
        bound_above=_largest_tail(bound),
    )


def _largest_tail(covs: Array) -> float:
    """Probability that an error is above ``DIVERGED_M``, of the largest of covariances (N, 2, 2);
    0 of none."""
    if not covs.size:
        return 0.0
    largest = covs[int(np.argmax(np.trace(covs, axis1=1, axis2=2)))]
    return float(gaussian_tail(largest[0, 0], largest[0, 1], largest[1, 1], DIVERGED_M))


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """Some seeds: their tallies, their histogram (BINS + 1,), and where asked for squared errors
    and bounds (runs, N)."""

    tallies: list[Tally]
    histogram: Ints
    error2: Array | None = None
    bound2: Array | None = None


def _batch(argument: tuple[Experiment, int, bool], seeds: range) -> Batch:
    experiment, skip, series = argument
    setup = setup_of(experiment)
    histogram = np.zeros(BINS + 1, dtype=np.int64)
    tallies, squares, bounds = [], [], []
    for seed in seeds:
        track = setup.run(seed)
        tallies.append(tally(track, setup.config.initial_position_sd_max_m, histogram, skip))
        if series:
            squares.append(track.error_m**2)
            bounds.append(track.bound[:, 0, 0] + track.bound[:, 1, 1])
    return Batch(
        tallies=tallies,
        histogram=histogram,
        error2=_stacked(squares),
        bound2=_stacked(bounds),
    )


def _stacked(series: list[Array]) -> Array | None:
    """(runs, N), NaN where a run is shorter; None of nothing."""
    if not series:
        return None
    out = np.full((len(series), max(s.size for s in series)), np.nan)
    for row, values in zip(out, series, strict=True):
        row[: values.size] = values
    return out


def _joined(parts: list[Array | None]) -> Array | None:
    """The series of all batches, ``_stacked``."""
    return _stacked([row for part in parts if part is not None for row in part])


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Figures over all runs of an experiment.

    rmse_m over all scored estimates, mean_error_m what fokin2020:eq.34 calls RMSE; clock_sd_ns
    about the mean; nees of the position (2 degrees of freedom), tested over runs; exceeded: share
    of estimates whose error is above their protection level, the mean of which is level_m, and
    exceeded_runs the runs that have such, None of an estimator without levels; bound_rmse_m the
    posterior Cramér-Rao bound of rmse_m; rate_hz and ready_s of the worst run, ready_s None where
    a run never got ready; error2, bound2 (runs, N) m^2 of all epochs for experiments with one
    route, error2 NaN where there is no track.
    """

    experiment: Experiment
    routes: Routes
    n: int
    rmse_m: float
    mean_error_m: float
    error_max_m: float
    clock_sd_ns: float
    clock_rmse_ns: float
    heading_rmse_deg: float | None
    nees: MeanTest
    nis_over_dof: float | None
    exceeded: float | None
    exceeded_runs: int | None
    level_m: float | None
    bound_rmse_m: float
    rate_hz: float
    ready_s: float | None
    speed_max_mps: float
    histogram: Ints
    error2: Array | None
    bound2: Array | None

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.routes.runs

    @property
    def bound_ratio(self) -> float:
        """RMSE over the posterior Cramér-Rao bound."""
        return self.rmse_m / self.bound_rmse_m

    def share_within(self, error_m: float) -> float:
        """Share of estimates whose error is below a whole number of histogram bins."""
        return float(self.histogram[: round(error_m / BIN_M)].sum() / self.histogram.sum())

    def percentile_m(self, percent: float) -> float | None:
        """Error that a share of the estimates keeps, to one bin (2 mm), upper edge; None beyond
        the histogram (20 m)."""
        reached = np.cumsum(self.histogram) >= percent / 100 * self.histogram.sum()
        place = int(np.argmax(reached))
        return (place + 1) * BIN_M if place < BINS else None

    @classmethod
    def of(cls, experiment: Experiment, batches: Iterable[Batch]) -> Summary:
        """Figures of batches in the order of the seeds.

        Raises
        ------
        NothingScoredError  no run has an estimate beyond those left out
        """
        kept = list(batches)
        tallies = [t for batch in kept for t in batch.tallies]
        n, routes = sum(t.n for t in tallies), Routes.of(tallies)
        if n == 0:
            raise NothingScoredError(f"{experiment.name}: no run has estimates that count", routes)
        clock = sum(t.clock for t in tallies) / n
        clock2 = sum(t.clock2 for t in tallies) / n
        headings, dof = sum(t.heading_n for t in tallies), sum(t.dof for t in tallies)
        levels = experiment.estimator != "paper"
        ready = [t.ready_s for t in tallies]
        return cls(
            experiment=experiment,
            routes=routes,
            n=n,
            rmse_m=float(np.sqrt(sum(t.error2 for t in tallies) / n)),
            mean_error_m=sum(t.error for t in tallies) / n,
            error_max_m=max(t.error_max for t in tallies),
            clock_sd_ns=float(np.sqrt(max(clock2 - clock**2, 0.0))),
            clock_rmse_ns=float(np.sqrt(clock2)),
            heading_rmse_deg=float(
                np.rad2deg(np.sqrt(sum(t.heading2 for t in tallies) / headings))
            )
            if headings
            else None,
            nees=nees_over_runs(
                np.array([t.nees for t in tallies]), np.array([t.n for t in tallies]), 2
            ),
            exceeded=sum(t.exceeded for t in tallies) / n if levels else None,
            exceeded_runs=sum(t.exceeded > 0 for t in tallies) if levels else None,
            level_m=sum(t.level for t in tallies) / n if levels else None,
            nis_over_dof=sum(t.nis for t in tallies) / dof if dof else None,
            bound_rmse_m=float(np.sqrt(sum(t.bound2 for t in tallies) / n)),
            rate_hz=min(t.rate_hz for t in tallies),
            ready_s=None if None in ready else max(r for r in ready if r is not None),
            speed_max_mps=max(t.speed_max for t in tallies),
            histogram=np.sum([batch.histogram for batch in kept], axis=0),
            error2=_joined([batch.error2 for batch in kept]),
            bound2=_joined([batch.bound2 for batch in kept]),
        )


def monte_carlo(
    work: Work, experiment: Experiment, *, skip: int = SKIP_EPOCHS, series: bool = False
) -> Summary:
    """Run an experiment over the seeds of ``work``. ``series`` keeps every error: for experiments
    whose epochs are the same in every run."""
    batches = work.over_seeds(experiment.name, _batch, (experiment, skip, series))
    return Summary.of(experiment, batches)
