"""A track learns how freely its device moves, and how its clock walks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from netpos.estimation.densities import PARAMETERS, START, Density
from netpos.estimation.engine import Epochs, Run, empty_run
from netpos.estimation.mixture.epoch import run_epochs
from netpos.estimation.motion import NO_BIAS, Parameter
from netpos.estimation.rows import linear_rows
from netpos.estimation.state import X
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement, TrackState
from netpos.tracking import Tracker
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators import estimates
from netpos.tracking.estimators.models import dynamics_of, options_of, pose_state
from netpos.tracking.estimators.strapdown_models import sensors_of
from scipy.constants import speed_of_light

T0, DT, SD, ROWS = 1_000_000_000, 0.1, 0.3, 3
BOTH = list(PARAMETERS)


def walk(seconds: float, seed: int) -> Array:
    """True positions (N, 2) of a person: straight for 2 to 8 s, then another heading and speed
    within half a second, or a stop."""
    rng, n = np.random.default_rng(seed), round(seconds / DT)
    velocity, heading, left, wanted = np.array([1.2, 0.0]), 0.0, 0, np.zeros(2)
    way = np.zeros((n, 2))
    for k in range(1, n):
        if left == 0:
            left, heading = round(rng.uniform(2, 8) / DT), heading + rng.normal()
            speed = 0.0 if rng.random() < 0.15 else rng.uniform(0.8, 1.5)
            wanted = speed * np.array([math.cos(heading), math.sin(heading)])
        left -= 1
        velocity = velocity + (wanted - velocity) * DT / 0.4
        way[k] = way[k - 1] + velocity * DT
    return way


def forklift(seconds: float) -> Array:
    """True positions (N, 2): round and round a stadium, 4 m/s, arcs of 4 m, straights of 12 m."""
    arc, straight = 4 * math.pi, 12.0
    way = []
    for s in np.arange(round(seconds / DT)) * 4.0 * DT % (2 * (arc + straight)):
        half, rest = divmod(s, arc + straight)
        if rest < straight:
            x, y = rest - straight / 2, -4.0
        else:
            angle = (rest - straight) / 4.0 - math.pi / 2
            x, y = straight / 2 + 4.0 * math.cos(angle), 4.0 * math.sin(angle)
        way.append((x, y) if half == 0 else (-x, -y))
    return np.array(way)


def vehicle(seconds: float) -> Array:
    """True positions (N, 2): 4 m/s, a sharp turn every 30 s."""
    t, way = np.arange(round(seconds / DT)) * DT, []
    for now in t:
        legs, rest = divmod(now, 30.0)
        way.append(120.0 * np.array([(legs + 1) // 2, legs // 2]) + 4.0 * rest * _axis(legs))
    return np.array(way)


def _axis(legs: float) -> Array:
    return np.array([1.0, 0.0]) if legs % 2 == 0 else np.array([0.0, 1.0])


def epochs_of(way: Array, seed: int = 0, clock_step_m: float = 0.0) -> Epochs:
    """Position and clock offset, each with an sd of 0.3 m. The clock drifts by 3 m/s, and steps in
    the middle."""
    count = len(way)
    clock = 20.0 + 3.0 * DT * np.arange(count) + clock_step_m * (np.arange(count) >= count // 2)
    seen = np.column_stack([way, clock])
    seen += SD * np.random.default_rng([seed, 1]).standard_normal(seen.shape)
    measured = np.eye(6)[[X.PX, X.PY, X.CLOCK]]
    rows = [linear_rows(z, SD**2 * np.eye(3), measured, 0) for z in seen]
    stamps = T0 + np.round(np.arange(count) * DT * 1e9).astype(np.int64)
    return Epochs(stamps, ROWS * np.arange(count + 1), np.vstack(rows))


def compiled(config: TrackerConfig, epochs: Epochs, way: Array) -> Run:
    n = len(way)
    run = empty_run(n, 6)
    mean, cov = pose_state(config, way[0], np.eye(2))
    dynamics = dynamics_of(config, NO_BIAS)
    assert run_epochs(epochs, mean, cov, dynamics, options_of(config), run) == n
    return run


def score(run: Run, way: Array) -> tuple[float, float]:
    """RMSE [m] and mean NEES (2 expected) after ten seconds."""
    error = (run.means[:, :2] - way)[100:]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(run.covs[100:, :2, :2]), error)
    return math.sqrt((error**2).sum(axis=1).mean()), float(nees.mean())


@pytest.mark.parametrize("name", ["person", "forklift", "vehicle"])
def test_the_defaults_are_true_of_every_device(name: str) -> None:
    """The covariance holds for each, and the error is at most 1.25 times that with the best of
    four densities, held."""
    ways = {
        "person": [walk(150.0, seed) for seed in (1, 2, 3)],
        "forklift": [forklift(150.0)] * 3,
        "vehicle": [vehicle(150.0)] * 3,
    }[name]
    figures: dict[float, Array] = {}
    for density in (0.0, 0.1, 0.3, 1.0, 3.0):
        config = TrackerConfig(accel_density_mps2_sqrthz=density)
        runs = [
            score(compiled(config, epochs_of(way, seed), way), way)
            for seed, way in enumerate(ways)
        ]
        figures[density] = np.mean(runs, axis=0)
    learned = figures.pop(0.0)
    assert learned[1] < 2.5, figures
    assert learned[0] < 1.25 * min(rmse for rmse, _ in figures.values()), figures


def test_one_kernel_and_the_track_learn_the_same() -> None:
    """To the last bit, with turns that have components of their own."""
    config, way = TrackerConfig(), vehicle(70.0)
    epochs = epochs_of(way)
    run = compiled(config, epochs, way)
    estimate = estimates.Estimate(config, T0, *pose_state(config, way[0], np.eye(2)))
    for k, stamp in enumerate(epochs.stamps_ns.tolist()):
        rows = epochs.rows[ROWS * k : ROWS * (k + 1)].copy()
        estimate.step(stamp, DT if k else 0.0, 0, rows, NO_BIAS)
        np.testing.assert_array_equal(run.densities[k], estimate.motion[BOTH])
        np.testing.assert_array_equal(run.means[k], estimate.mean)
    np.testing.assert_allclose(run.densities[0], START)
    assert run.densities[280, Density.ACCEL] < 0.7 * START[Density.ACCEL]
    assert run.densities[280, Density.CLOCK] < 0.1 * START[Density.CLOCK]


def test_a_copy_learns_for_itself() -> None:
    epochs = epochs_of(forklift(20.0))
    config = TrackerConfig()
    estimate = estimates.Estimate(config, T0, *pose_state(config, np.zeros(2), 100 * np.eye(2)))

    def onward(one: estimates.Estimate, first: int, end: int) -> list[float]:
        for k in range(first, end):
            rows = epochs.rows[ROWS * k : ROWS * (k + 1)].copy()
            one.step(int(epochs.stamps_ns[k]), DT, 0, rows, NO_BIAS)
        return one.motion[BOTH].tolist()

    kept = onward(estimate, 0, 100)
    twin = estimate.copy()
    moved = onward(twin, 100, 200)
    assert all(np.not_equal(kept, moved))
    assert onward(estimate, 100, 200) == moved


@pytest.mark.parametrize(
    ("settings", "held", "densities"),
    [
        ({"accel_density_mps2_sqrthz": 0.3}, [Density.ACCEL], [0.3]),
        ({"clock_walk_density": 1e-8}, [Density.CLOCK], [1e-8 * speed_of_light]),
        ({"manoeuvre_speed_sd_mps": 0.0}, [Density.CLOCK], [START[Density.CLOCK]]),
        ({"motion_model": "interacting"}, list(Density), list(START)),
        ({"filter": "kf"}, list(Density), list(START)),
    ],
)
def test_others_hold_theirs(
    settings: dict[str, object], held: list[Density], densities: list[float]
) -> None:
    config = TrackerConfig(**settings)  # type: ignore[arg-type]
    assert [which for which in Density if not config.learns_density[which]] == held
    estimate = estimates.Estimate(config, T0, *pose_state(config, np.zeros(2), np.eye(2)))
    epochs = epochs_of(forklift(5.0))
    for k in range(50):
        rows = epochs.rows[ROWS * k : ROWS * (k + 1)].copy()
        estimate.step(int(epochs.stamps_ns[k]), DT, 0, rows, NO_BIAS)
        assert estimate.motion[BOTH][held] == pytest.approx(densities)


def test_a_strapdown_track_holds_its_clock() -> None:
    config = TrackerConfig(motion_model="strapdown")
    assert sensors_of(config).slow.clock_walk == pytest.approx(START[Density.CLOCK])
    assert config.learns_density == (False, False)


def test_a_change_of_one_keeps_the_other() -> None:
    config, epochs = TrackerConfig(), epochs_of(forklift(20.0))
    estimate = estimates.Estimate(config, T0, *pose_state(config, np.zeros(2), 100 * np.eye(2)))
    for k in range(150):
        rows = epochs.rows[ROWS * k : ROWS * (k + 1)].copy()
        estimate.step(int(epochs.stamps_ns[k]), DT, 0, rows, NO_BIAS)
    known = estimate.motion[PARAMETERS[Density.CLOCK]]
    assert known < 0.2 * START[Density.CLOCK]
    estimate.set_config(replace(config, accel_density_mps2_sqrthz=0.7))
    estimate.predict(int(epochs.stamps_ns[150]), NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == 0.7
    assert estimate.motion[PARAMETERS[Density.CLOCK]] == pytest.approx(known, rel=0.05)


@pytest.mark.parametrize("step_m", [30.0, 3e4])
def test_a_step_of_the_clock_is_no_walk(step_m: float) -> None:
    """Two seconds after it each density is what it would be without it, within 15 %."""
    way, config = forklift(40.0), TrackerConfig()
    with_step, without = (
        compiled(config, epochs_of(way, 3, step), way).densities[220] for step in (step_m, 0.0)
    )
    assert with_step == pytest.approx(without, rel=0.15)


def test_a_declared_density_holds_from_the_next_epoch_on() -> None:
    config = TrackerConfig()
    estimate = estimates.Estimate(config, T0, *pose_state(config, np.zeros(2), np.eye(2)))
    estimate.predict(T0 + 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == pytest.approx(START[Density.ACCEL])
    estimate.set_config(replace(config, accel_density_mps2_sqrthz=0.7))
    estimate.predict(T0 + 2 * 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == estimate.accel_density == 0.7
    estimate.set_config(config)
    estimate.predict(T0 + 3 * 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == pytest.approx(START[Density.ACCEL])


def test_steps_say_more_up_to_the_next_epoch() -> None:
    config = TrackerConfig()
    estimate = estimates.Estimate(config, T0, *pose_state(config, np.zeros(2), np.eye(2)))
    estimate.set_process_noise(0.05)
    estimate.predict(T0 + 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == 0.05
    estimate.predict(T0 + 2 * 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == pytest.approx(START[Density.ACCEL])


SITES = {"a": (0, 0, 3), "b": (30, 0, 3), "c": (30, 20, 3), "d": (0, 20, 3), "e": (15, -5, 3)}
TIME_SD_M = 0.2
STEP_S = 30.0


def _person(now: float) -> Array:
    return np.array([15 + 8 * math.sin(0.1 * now), 10 + 5 * math.cos(0.13 * now), 0.0])


class Followed(NamedTuple):
    """Of each output its time [s], the horizontal error [m], the protection level [m] and the
    state; how often the track was lost; errors (n, 2) [m] of its smoothed places over time."""

    times: Array
    errors: Array
    levels: Array
    states: Array
    lost: int
    smoothed: Array

    def rmse(self, first_s: float, end_s: float) -> float:
        some = self.errors[(self.times > first_s) & (self.times <= end_s)]
        return math.sqrt((some**2).mean())


def by_times(
    seed: int, step_s: float = 0.0, at_once: bool = True, walk: float = 0.0, **config: float
) -> Followed:
    """A minute of times of arrival of a person, 5 Hz, by five RSUs at once or in turn. The drift
    of the clock, 10 ns/s, does a random walk of density ``walk`` [(s/s)/sqrt(s)], and its offset
    steps by ``step_s`` after half of it."""
    rng, c = np.random.default_rng(seed), speed_of_light
    steps = 0.2 * walk * np.random.default_rng([seed, 2]).normal(size=1500)  # one each 0.04 s
    drifts = 1e-8 + steps.cumsum()
    offsets = 50e-9 + 0.04 * drifts.cumsum()
    settings = {"hold_s": 0.0, "initial_speed_sd_mps": 1.5, **config}
    tracker = Tracker(TrackerConfig(**settings), keep_posteriors=True)  # type: ignore[arg-type]
    for name, site in SITES.items():
        tracker.add_rsu(RsuInfo(rsu_id=name, position=np.array(site, dtype=float)))
    found, lost = [], 0
    for k in range(300):
        for i, name in enumerate(SITES):
            now = k / 5.0 + (0.0 if at_once else i / 25.0)
            clock_s = offsets[round(now / 0.04)] + (step_s if now > STEP_S else 0.0)
            path_m = float(np.linalg.norm(_person(now) - SITES[name])) + TIME_SD_M * rng.normal()
            item = RsuMeasurement(
                stamp_ns=T0 + round(1e9 * now),
                rsu_id=name,
                vue_id="v",
                sequence=k if at_once else 5 * k + i,
                expected=5 if at_once else 1,
                fields=Field.TOA,
                toa_s=path_m / c + clock_s,
                toa_var=(TIME_SD_M / c) ** 2,
            )
            assert tracker.add(item) is None
        for output in tracker.process():
            odometry, status = output.odometry, output.status
            if odometry is not None and status is not None:
                now = (odometry.stamp_ns - T0) * 1e-9
                error = float(np.linalg.norm((odometry.position - _person(now))[:2]))
                level = status.protection_level_m
                found.append((now, error, level, status.state))
                lost = status.rejected.get("track_lost", 0)
    smoothed = []
    for odometry in tracker.smoothed()["v"]:
        now = (odometry.stamp_ns - T0) * 1e-9
        smoothed.append((now, np.linalg.norm((odometry.position - _person(now))[:2])))
    return Followed(*np.array(found, dtype=float).T, lost, np.array(smoothed))


@pytest.mark.parametrize("at_once", [True, False])
def test_a_good_clock_is_as_good_as_told(at_once: bool) -> None:
    """After 20 s, over four runs: at most a twentieth more than where it is told, and in turn a
    tenth less than where it is held at what learning starts from."""
    rmse = {
        density: np.mean(
            [
                by_times(s, at_once=at_once, clock_walk_density=density).rmse(20, 60)
                for s in range(4)
            ]
        )
        for density in (0.0, 1e-9, 5e-7)
    }
    assert rmse[0.0] < 1.05 * rmse[1e-9]
    assert rmse[0.0] < (1.02 if at_once else 0.9) * rmse[5e-7]


@pytest.mark.parametrize("at_once", [True, False])
@pytest.mark.parametrize("walk", [1e-8, 5e-7, 2e-6])
def test_a_clock_that_walks_is_as_good_as_declared(walk: float, at_once: bool) -> None:
    """After 20 s, over four runs: at most a tenth more than where the density is declared, and no
    error above the level."""

    def rmse_of(density: float) -> float:
        runs = [by_times(s, 0.0, at_once, walk, clock_walk_density=density) for s in range(4)]
        for run in runs:
            assert not ((run.states == TrackState.TRACKING) & (run.errors > run.levels)).any()
        return float(np.mean([run.rmse(20.0, 60.0) for run in runs]))

    assert rmse_of(0.0) < 1.1 * rmse_of(walk)


@pytest.mark.parametrize("at_once", [True, False])
@pytest.mark.parametrize("step_ns", [10.0, 100.0, 1e5])
def test_a_clock_that_steps_ends_no_track(step_ns: float, at_once: bool) -> None:
    """No error above the level, and three seconds later all is as before; times that come at once
    show the step in the same epoch."""
    run = by_times(1, step_ns * 1e-9, at_once)
    assert not ((run.states == TrackState.TRACKING) & (run.errors > run.levels)).any()
    before, after = run.rmse(20.0, STEP_S), run.rmse(STEP_S + 3.0, STEP_S + 13.0)
    assert after < 1.5 * before
    assert run.lost == 0
    if at_once:
        assert run.rmse(STEP_S, STEP_S + 3.0) < 2.0 * before
        on = run.states[run.times > 1.0]
        assert np.isin(on, [TrackState.TRACKING, TrackState.AMBIGUOUS]).all()


@pytest.mark.parametrize("step_ns", [100.0, 1e5])
def test_a_smoother_does_not_reach_across_a_step_of_the_clock(step_ns: float) -> None:
    """Its errors in the five seconds before and after are as small as without the step."""

    def rmse_of(step_s: float) -> float:
        times, errors = by_times(1, step_s).smoothed.T
        some = errors[np.abs(times - STEP_S) < 5.0]
        return math.sqrt((some**2).mean())

    assert rmse_of(step_ns * 1e-9) < 1.3 * rmse_of(0.0)
