"""The tracker beside the particle filter: one case, and the summary of many."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from netpos.estimation.level.protection import protection_level
from netpos.estimation.mixture.gaussians import Mixture
from netpos.evaluation.consistency import MeanTest, nees_over_runs
from netpos.messages.values import Array
from netpos.tracking import Tracker, TrackerConfig
from oracle_problems import PROBLEMS, VUE, Case, Step, draw
from particle_filter import ParticleFilter
from posterior import Cloud, Modes
from scipy.stats import kstest

SHARE = 0.95
TARGETS = {"mean": 0.15, "trace": 0.15, "radius": 0.10, "modes": 0.05}
"""Largest differences: mean in posterior sd, ratios of traces and radii from 1, mode weights."""
_DRAWS = 20_000


@dataclass(slots=True, kw_only=True)
class Moment:
    """One posterior of one run, beside the tracker's (NaN where it had none)."""

    problem: int
    seed: int
    time_s: float
    own_radius: float
    """95 % radius of a Gaussian with the oracle's moments over the oracle's radius."""
    error: float
    nees: float
    rank: float
    """Weight nearer to the mean than the truth: uniform where the oracle is right."""
    modes: int = 0
    tracker_error: float = math.nan
    tracker_nees: float = math.nan
    tracker_inside: float = math.nan
    """1 where the truth is within the tracker's 95 % radius."""
    mean_apart: float = math.nan
    trace_ratio: float = math.nan
    radius_ratio: float = math.nan
    modes_apart: float = math.nan


def posteriors(case: Case, particles: int, seed: int) -> Iterator[tuple[Step, Cloud, float]]:
    """Scored steps with the oracle's posterior and the least effective number of particles."""
    oracle = ParticleFilter(case.start, case.motion, particles, seed)
    now = 0.0
    for step in case.steps:
        oracle.predict(step.time_s - now)
        now = step.time_s
        oracle.update(step.rows, guided=step.guided)
        if step.scored:
            cloud = Cloud(oracle.state[:, :2], oracle.probability)
            yield step, cloud, oracle.least_effective


class Tracked(NamedTuple):
    """A posterior of the tracker: position (2,) and covariance (2, 2) that it reports, and
    positions (``_DRAWS``, 2) drawn from its mixture."""

    mean: Array
    cov: Array
    drawn: Array


def tracked(case: Case, seed: int) -> dict[int, Tracked]:
    """What the tracker makes of the scored steps of a case, by stamp."""
    tracker, rng = Tracker(TrackerConfig(**case.config)), np.random.default_rng(seed)
    for info in case.rsus:
        tracker.add_rsu(info)
    found = {}
    for step in case.steps:
        for item in step.items:
            reason = tracker.add(item)
            if reason is not None:
                raise ValueError(f"the tracker refused an item of the simulation: {reason}")
        for output in (*tracker.process(), *tracker.flush()):
            odometry = output.odometry
            if step.scored and odometry is not None:
                mean, cov = odometry.position[:2], odometry.pose_cov[:2, :2]
                drawn = _draws(tracker.track(VUE).components, rng)
                found[odometry.stamp_ns] = Tracked(mean, cov, drawn)
    return found


def _draws(components: Mixture | None, rng: np.random.Generator) -> Array:
    """Positions (``_DRAWS``, 2) from a mixture."""
    assert components is not None
    weights = np.exp(components.log_weights)
    counts = rng.multinomial(_DRAWS, weights / weights.sum())
    return np.concatenate(
        [
            rng.multivariate_normal(mean[:2], cov[:2, :2], count)
            for mean, cov, count in zip(components.means, components.covs, counts, strict=True)
        ]
    )


def apart(mean: Array, cloud: Cloud) -> float:
    """Distance of ``mean`` from the cloud's in its standard deviations per axis."""
    d = mean - cloud.mean
    return math.sqrt(float(d @ np.linalg.solve(cloud.cov, d)) / 2.0)


def _nees(error: Array, cov: Array) -> float:
    return float(error @ np.linalg.solve(cov, error))


def _beside(moment: Moment, truth: Array, cloud: Cloud, modes: Modes, tracked: Tracked) -> None:
    """Add the tracker's figures."""
    mean, cov, drawn = tracked
    error = truth - mean
    radius = float(np.quantile(np.hypot(*(drawn - mean).T), SHARE))
    moment.tracker_error, moment.tracker_nees = math.hypot(*error), _nees(error, cov)
    moment.tracker_inside = float(math.hypot(*error) < radius)
    moment.mean_apart = apart(mean, cloud)
    moment.trace_ratio = float(np.trace(cov) / np.trace(cloud.cov))
    moment.radius_ratio = radius / cloud.radius(SHARE)
    moment.modes_apart = float(np.abs(modes.shares_of(drawn) - modes.weights).max())


def _moment(problem: int, seed: int, step: Step, cloud: Cloud) -> Moment:
    """The oracle's own figures."""
    error = step.truth[:2] - cloud.mean
    return Moment(
        problem=problem,
        seed=seed,
        time_s=step.time_s,
        own_radius=protection_level(cloud.cov, 1.0 - SHARE) / cloud.radius(SHARE),
        error=math.hypot(*error),
        nees=_nees(error, cloud.cov),
        rank=cloud.share_within(math.hypot(*error)),
    )


def alone(problem: int, seed: int, particles: int, share: float = 1.0) -> list[Moment]:
    """Every scored moment of one run of the oracle, without the tracker and without modes."""
    steps = posteriors(draw(problem, seed, share), particles, seed)
    return [_moment(problem, seed, step, cloud) for step, cloud, _ in steps]


def compare(problem: int, seed: int, particles: int, share: float = 1.0) -> list[Moment]:
    """Every scored moment of one run of both filters."""
    case = draw(problem, seed, share)
    ours, moments = tracked(case, seed), []
    count = particles * PROBLEMS[problem].factor
    for step, cloud, _ in posteriors(case, count, seed):
        modes = Modes(cloud)
        moment = _moment(problem, seed, step, cloud)
        moment.modes = len(modes.weights)
        stamp = step.items[-1].stamp_ns
        if stamp in ours:
            _beside(moment, step.truth[:2], cloud, modes, ours[stamp])
        moments.append(moment)
    return moments


@dataclass(slots=True, kw_only=True)
class Check:
    """The oracle against itself with twice the particles."""

    problem: int
    mean_apart: float
    trace_ratio: float
    radius_ratio: float
    modes_apart: float
    least_effective: float


def doubled(problem: int, seed: int, particles: int, share: float = 1.0) -> list[Check]:
    """The same data to an oracle of ``particles`` and one of twice as many, by moment."""
    case, checks = draw(problem, seed, share), []
    count = particles * PROBLEMS[problem].factor
    few = posteriors(case, count, seed)
    many = posteriors(case, 2 * count, seed + 1_000_000)
    for (_, a, least), (_, b, _) in zip(few, many, strict=True):
        modes = Modes(b)
        sampled = np.random.default_rng(seed).choice(len(a.xy), _DRAWS, p=a.weights)
        checks.append(
            Check(
                problem=problem,
                mean_apart=apart(a.mean, b),
                trace_ratio=float(np.trace(a.cov) / np.trace(b.cov)),
                radius_ratio=a.radius(SHARE) / b.radius(SHARE),
                modes_apart=float(np.abs(modes.shares_of(a.xy[sampled]) - modes.weights).max()),
                least_effective=least,
            )
        )
    return checks


def nees_test(moments: Sequence[Moment], name: str) -> MeanTest | None:
    """NEES of the runs, by the spread between them; None where there is none."""
    runs: dict[int, list[float]] = {}
    for moment in moments:
        value = getattr(moment, name)
        if not math.isnan(value):
            runs.setdefault(moment.seed, []).append(value)
    if not runs:
        return None
    sums = np.array([sum(values) for values in runs.values()])
    return nees_over_runs(sums, np.array([len(v) for v in runs.values()]), 2)


def rank_p_value(moments: Sequence[Moment]) -> float:
    """P-value that the ranks are uniform (Kolmogorov-Smirnov), of one moment of each run drawn at
    random: those of one run are not independent."""
    runs: dict[int, list[float]] = {}
    for moment in moments:
        runs.setdefault(moment.seed, []).append(moment.rank)
    rng = np.random.default_rng(1)
    ranks = [values[int(rng.integers(len(values)))] for values in runs.values()]
    return float(kstest(ranks, "uniform").pvalue)


@dataclass(slots=True, kw_only=True)
class Summary:
    """Figures of one problem; differences are means over moments, None without any."""

    problem: int
    name: str
    moments: int
    silent: float
    """Share of moments at which the tracker had no estimate."""
    differences: dict[str, float | None]
    mean_apart_median: float | None
    trace_ratio: float | None
    radius_ratio: float | None
    rmse: float
    tracker_rmse: float | None
    rmse_beside: float | None
    """The oracle's RMSE at the moments at which the tracker had an estimate."""
    nees: float
    nees_bounds: tuple[float, float]
    nees_median: float
    tracker_nees: float | None
    tracker_nees_bounds: tuple[float, float] | None
    tracker_nees_median: float | None
    covered: float
    tracker_covered: float | None
    rank_p: float
    modes_mean: float
    modes_max: int
    own_radius: float

    def excess(self) -> float:
        """Largest difference over its target."""
        shares = [v / TARGETS[k] for k, v in self.differences.items() if v is not None]
        return max(shares, default=0.0)

    def to_json(self) -> dict[str, Any]:
        """Plain types."""
        return asdict(self)


def _values(moments: Sequence[Moment], name: str) -> Array:
    values = np.array([getattr(m, name) for m in moments], dtype=float)
    return values[~np.isnan(values)]


def _mean(values: Array) -> float | None:
    return float(values.mean()) if values.size else None


def _rms(values: Array) -> float | None:
    return math.sqrt(float((values**2).mean())) if values.size else None


def _median(values: Array) -> float | None:
    return float(np.median(values)) if values.size else None


def off_one(ratios: Array) -> float | None:
    """How far ratios are from 1, up or down alike."""
    return float(np.exp(np.abs(np.log(ratios)).mean()) - 1.0) if ratios.size else None


def summarise(moments: Sequence[Moment]) -> Summary:
    """Summary of the moments of one problem, at least one."""
    heard = [m for m in moments if not math.isnan(m.tracker_error)]
    own, other = nees_test(moments, "nees"), nees_test(moments, "tracker_nees")
    assert own is not None
    traces, radii = _values(heard, "trace_ratio"), _values(heard, "radius_ratio")
    modes = _values(moments, "modes")
    return Summary(
        problem=moments[0].problem,
        name=PROBLEMS[moments[0].problem].name,
        moments=len(moments),
        silent=1.0 - len(heard) / len(moments),
        differences={
            "mean": _mean(_values(heard, "mean_apart")),
            "trace": off_one(traces),
            "radius": off_one(radii),
            "modes": _mean(_values(heard, "modes_apart")),
        },
        mean_apart_median=_median(_values(heard, "mean_apart")),
        trace_ratio=_median(traces),
        radius_ratio=_median(radii),
        rmse=_rms(_values(moments, "error")) or 0.0,
        tracker_rmse=_rms(_values(heard, "tracker_error")),
        rmse_beside=_rms(_values(heard, "error")),
        nees=own.mean,
        nees_bounds=own.bounds,
        nees_median=float(np.median(_values(moments, "nees"))),
        tracker_nees=other.mean if other else None,
        tracker_nees_bounds=other.bounds if other else None,
        tracker_nees_median=_median(_values(heard, "tracker_nees")),
        covered=float((_values(moments, "rank") < SHARE).mean()),
        tracker_covered=_mean(_values(heard, "tracker_inside")),
        rank_p=rank_p_value(moments),
        modes_mean=float(modes.mean()),
        modes_max=int(modes.max()),
        own_radius=float(np.median(_values(moments, "own_radius"))),
    )
