"""A person whose steps are not as long as dead reckoning believes, and whose heading is off, round
petukhov's rectangle with the anchor hidden: with and without a state for it.

Everything goes through the tracker as in a live run, but a step's velocity comes during the step;
parameters are those of the scenario ``pedestrian_rectangle``. The paper's scheme and the library's
defaults, neither of which estimates the person, walk beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from netpos.estimation.measurement import ORIGIN
from netpos.evaluation.consistency import MeanTest, nees, nees_over_runs
from netpos.evaluation.work import Work
from netpos.messages.values import Array, Beacon, TrackState, Velocity
from netpos.radio.noise import generator
from netpos.reproduction.experiment import VUE
from netpos.reproduction.frame import Row, required, shown
from netpos.reproduction.petukhov.chain_rows import SCHEME
from netpos.reproduction.petukhov.rectangle import ERRORS, Case, setup_of
from netpos.reproduction.petukhov.steps import Person, reported_velocity, velocity_rows
from netpos.reproduction.petukhov.waist_chain import Variant
from netpos.reproduction.petukhov.walk_figures import FAR_M
from netpos.tracking import Tracker, TrackOutput

RUNS = 100  # at most: every run is a tracker's, message by message
HIDDEN_S = (10.0, 25.0)
OFF = (0.10, 0.15)  # of the length
HEADING_SD_RAD = math.radians(3.0)

UNKNOWN = Variant(name="not estimated")
ESTIMATED = Variant(
    name="estimated",
    settings=(("step_length_factor_sd", 0.12), ("step_heading_offset_sd_rad", 0.05)),
)
DEFAULTS = Variant(name="defaults", defaults=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Walk:
    """One run from the decision about the sector on: times_s (n,), error (n, 2) m, covariance
    (n, 2, 2). When the anchor was hidden: relative error of the length factor and error of the
    heading offset [rad], and the sd of both."""

    times_s: Array
    error: Array
    cov: Array
    off: tuple[float, float]
    sd: tuple[float, float]


def person_of(seed: int) -> Person:
    """Steps 10 to 15 % shorter or longer than reported, and a heading off by 3° (sd)."""
    rng = generator(seed, f"{VUE}/person")
    off = rng.choice([-1.0, 1.0]) * rng.uniform(*OFF)
    return Person(length_factor=1.0 + off, heading_offset_rad=HEADING_SD_RAD * rng.normal())


def case_of(variant: Variant) -> Case:
    """The rectangle with the anchor hidden."""
    return Case(
        name="person",
        wavelengths=4.0,
        tracker=variant.settings,
        defaults=variant.defaults,
        hidden_s=HIDDEN_S,
    )


def walk(seed: int, variant: Variant) -> Walk:
    """One seed through a tracker."""
    setup, person = setup_of(case_of(variant)), person_of(seed)
    rng = generator(seed, f"{VUE}/steps")
    rows, _ = velocity_rows(setup.times_s, setup.steps, ERRORS, rng, 0.0, person)
    tracker = Tracker(setup.config)
    simulation = setup.simulation.with_seed(seed)
    for rsu in simulation.rsus:
        tracker.add_rsu(rsu)
    outputs: list[TrackOutput] = []
    beacons = (event for event in simulation.events() if isinstance(event, Beacon))
    for k, beacon in enumerate(beacons):
        if setup.heard[k]:
            for measurement in simulation.measure(beacon):
                tracker.add(measurement)
        inverse = np.linalg.inv(rows[k, :, ORIGIN + 2 : ORIGIN + 4])
        velocity = Velocity(
            stamp_ns=beacon.stamp_ns,
            vue_id=VUE,
            velocity=np.round(reported_velocity(rows[k]), 12),
            cov=inverse @ inverse.T,
        )
        tracker.add(velocity)
        outputs += tracker.process()
    outputs += tracker.flush()
    return _scored(outputs, dict(zip(setup.stamps_ns.tolist(), setup.truth, strict=True)), person)


def _scored(outputs: list[TrackOutput], truth: dict[int, Array], person: Person) -> Walk:
    last = {o.status.stamp_ns: o for o in outputs}
    start_ns = min(truth)
    rows = []
    for stamp_ns, output in sorted(last.items()):
        if output.status.state in (TrackState.TRACKING, TrackState.COASTING):
            assert output.odometry is not None
            error = output.odometry.position[:2] - truth[stamp_ns]
            rows.append(((stamp_ns - start_ns) * 1e-9, error, output.odometry.pose_cov[:2, :2]))
    times, errors, covs = (np.array(column) for column in zip(*rows, strict=True))
    hidden = [o for ns, o in sorted(last.items()) if (ns - start_ns) * 1e-9 < HIDDEN_S[0]]
    known = hidden[-1].status.steps
    factor_off = known.length_factor / person.length_factor - 1.0
    heading_off = known.heading_offset_rad - person.heading_offset_rad
    return Walk(
        times_s=times,
        error=errors,
        cov=covs,
        off=(factor_off, heading_off),
        sd=(known.length_factor_sd / known.length_factor, known.heading_offset_sd_rad),
    )


def _job(variant: Variant, seeds: range) -> list[Walk]:
    return [walk(seed, variant) for seed in seeds]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Summary:
    """heard_rmse_m : while the anchor is heard. hidden_rmse_m, hidden_nees : once it has been
    hidden for 5 s. first_s : mean time of the first scored estimate. far : share of runs with an
    error above 5 m."""

    heard_rmse_m: float
    hidden_rmse_m: float
    hidden_nees: MeanTest
    first_s: float
    far: float

    @classmethod
    def of(cls, runs: list[Walk]) -> _Summary:
        heard, _ = window(runs, 0.0, HIDDEN_S[0])
        hidden, test = window(runs, HIDDEN_S[0] + 5.0, HIDDEN_S[1])
        far = [(np.hypot(*run.error.T) > FAR_M).any() for run in runs]
        return cls(
            heard_rmse_m=heard,
            hidden_rmse_m=hidden,
            hidden_nees=test,
            first_s=float(np.mean([run.times_s[0] for run in runs])),
            far=float(np.mean(far)),
        )


def rows(work: Work) -> Iterator[Row]:
    """Figures of all, hidden and not."""
    few = work.with_runs(min(work.runs, RUNS))
    walks = {
        variant.name: [
            run
            for part in few.over_seeds(f"person, {variant.name}", _job, variant)
            for run in part
        ]
        for variant in (UNKNOWN, ESTIMATED, SCHEME, DEFAULTS)
    }
    by = {name: _Summary.of(runs) for name, runs in walks.items()}
    name = "steps 10 to 15 % off, heading 3 deg"
    for what in (UNKNOWN.name, ESTIMATED.name):
        columns = by[what], by[SCHEME.name], by[DEFAULTS.name]
        yield from _compared(f"{name}, {what}", *columns, judged=what == ESTIMATED.name)
    off = np.array([run.off for run in walks[ESTIMATED.name]])
    sd = np.array([run.sd for run in walks[ESTIMATED.name]])
    for i, (what, unit) in enumerate((("length factor", "1"), ("heading offset", "rad"))):
        rms = float(np.sqrt(np.mean(off[:, i] ** 2)))
        yield shown(f"{name}: error of the {what} after 10 s, RMS", unit, rms)
        mean_sd = float(np.sqrt(np.mean(sd[:, i] ** 2)))
        yield required(f"{name}: sd of the {what} then", unit, mean_sd, rms <= 1.2 * mean_sd)


def _compared(
    name: str, ours: _Summary, paper: _Summary, defaults: _Summary, *, judged: bool
) -> Iterator[Row]:
    """``judged``: the NEES is, as only a filter that estimates the person can be consistent."""
    row = shown(f"{name}: RMSE", "m", ours.heard_rmse_m)
    yield row.beside(paper.heard_rmse_m, defaults.heard_rmse_m)
    row = shown(f"{name}: RMSE, anchor hidden for 5 to 15 s", "m", ours.hidden_rmse_m)
    yield row.beside(paper.hidden_rmse_m, defaults.hidden_rmse_m)
    test = ours.hidden_nees
    label = f"{name}: NEES then, mean (expected 2)"
    ok = test.consistent if judged else None
    row = Row(name=label, unit="1", paper=None, ours=test.mean, ok=ok)
    yield row.beside(paper.hidden_nees.mean, defaults.hidden_nees.mean)
    row = shown(f"{name}: time before the first scored estimate", "s", ours.first_s)
    yield row.beside(paper.first_s, defaults.first_s)
    row = shown(f"{name}: share of runs with an error above 5 m", "1", ours.far)
    yield row.beside(paper.far, defaults.far)


def window(runs: list[Walk], from_s: float, to_s: float) -> tuple[float, MeanTest]:
    """RMSE [m] and NEES of the estimates between two times."""
    errors, sums, counts = [], [], []
    for run in runs:
        use = (run.times_s >= from_s) & (run.times_s < to_s)
        values = nees(run.error[use], run.cov[use])[0]
        errors.append(run.error[use])
        sums.append(values.sum())
        counts.append(values.size)
    rmse = float(np.sqrt((np.concatenate(errors) ** 2).sum(axis=1).mean()))
    return rmse, nees_over_runs(np.array(sums), np.array(counts), 2)
