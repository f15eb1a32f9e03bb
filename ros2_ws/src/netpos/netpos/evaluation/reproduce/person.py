"""A person whose steps are not as long as dead reckoning believes, and whose heading is off, round
petukhov's rectangle with the anchor hidden: with and without a state for it.

Everything goes through the tracker as in a live run; its parameters are those of the scenario
``pedestrian_rectangle``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from netpos.evaluation.consistency import nees
from netpos.evaluation.reproduce.experiment import VUE
from netpos.evaluation.reproduce.frame import Row, Work, required, shown
from netpos.evaluation.reproduce.rectangle import ERRORS, Case, setup_of
from netpos.evaluation.reproduce.steps import Person, reported_velocity, velocity_rows
from netpos.filters.measurement import ORIGIN
from netpos.messages.values import Array, Beacon, TrackState, Velocity
from netpos.radio.noise import generator
from netpos.tracking import Tracker, TrackOutput

RUNS = 100  # at most: every run is a tracker's, message by message
HIDDEN_S = (10.0, 25.0)
OFF = (0.10, 0.15)  # of the length
HEADING_SD_RAD = math.radians(3.0)
Settings = tuple[tuple[str, object], ...]

UNKNOWN: Settings = (("step_length_factor_sd", 0.0), ("step_heading_offset_sd_rad", 0.0))
ESTIMATED: Settings = (("step_length_factor_sd", 0.12), ("step_heading_offset_sd_rad", 0.05))


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


def case_of(settings: Settings) -> Case:
    """The rectangle with the anchor hidden."""
    return Case(name="person", wavelengths=4.0, tracker=settings, hidden_s=HIDDEN_S)


def walk(seed: int, settings: Settings) -> Walk:
    """One seed through a tracker with ``settings`` over the scenario's own."""
    setup, person = setup_of(case_of(settings)), person_of(seed)
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


def _job(settings: Settings, seeds: range) -> list[Walk]:
    return [walk(seed, settings) for seed in seeds]


def rows(work: Work) -> Iterator[Row]:
    """Figures of both, hidden and not."""
    few = work.with_runs(min(work.runs, RUNS))
    unknown, estimated = (
        [run for part in few.over_seeds(f"person, {label}", _job, settings) for run in part]
        for label, settings in (("unknown", UNKNOWN), ("estimated", ESTIMATED))
    )
    name = "steps 10 to 15 % off, heading 3 deg"
    for what, runs in (("not estimated", unknown), ("estimated", estimated)):
        heard, _ = _scores(runs, 0.0, HIDDEN_S[0])
        hidden, values = _scores(runs, HIDDEN_S[0] + 5.0, HIDDEN_S[1])
        yield shown(f"{name}, {what}: RMSE", "m", heard)
        yield shown(f"{name}, {what}: RMSE, anchor hidden for 5 to 15 s", "m", hidden)
        yield shown(f"{name}, {what}: NEES then, mean (expected 2)", "1", values)
    off = np.array([run.off for run in estimated])
    sd = np.array([run.sd for run in estimated])
    for i, (what, unit) in enumerate((("length factor", "1"), ("heading offset", "rad"))):
        rms = float(np.sqrt(np.mean(off[:, i] ** 2)))
        yield shown(f"{name}: error of the {what} after 10 s, RMS", unit, rms)
        mean_sd = float(np.sqrt(np.mean(sd[:, i] ** 2)))
        yield required(f"{name}: sd of the {what} then", unit, mean_sd, rms <= 1.2 * mean_sd)


def _scores(runs: list[Walk], from_s: float, to_s: float) -> tuple[float, float]:
    """RMSE [m] and mean NEES of the estimates between two times."""
    chosen = [(run, (run.times_s >= from_s) & (run.times_s < to_s)) for run in runs]
    error = np.concatenate([run.error[use] for run, use in chosen])
    cov = np.concatenate([run.cov[use] for run, use in chosen])
    rmse = float(np.sqrt((error**2).sum(axis=1).mean()))
    return rmse, float(nees(error, cov)[0].mean())
