"""A track learns how freely its device moves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from netpos.estimation.accel_density import START
from netpos.estimation.engine import Epochs, Run
from netpos.estimation.mixture.epoch import run_epochs
from netpos.estimation.motion import NO_BIAS, Parameter
from netpos.estimation.rows import linear_rows
from netpos.messages.values import Array
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators import estimates
from netpos.tracking.estimators.models import dynamics_of, options_of, pose_state

T0, DT, SD = 1_000_000_000, 0.1, 0.3


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


def epochs_of(way: Array, seed: int = 0) -> Epochs:
    noise = SD * np.random.default_rng([seed, 1]).standard_normal(way.shape)
    rows = [linear_rows(z, SD**2 * np.eye(2), np.eye(2, 6), 0) for z in way + noise]
    stamps = T0 + np.round(np.arange(len(way)) * DT * 1e9).astype(np.int64)
    return Epochs(stamps, 2 * np.arange(len(way) + 1), np.vstack(rows))


def compiled(config: TrackerConfig, epochs: Epochs, way: Array) -> Run:
    n = len(way)
    run = Run(np.empty((n, 6)), np.empty((n, 6, 6)), *np.empty((6, n)))
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
        rows = epochs.rows[2 * k : 2 * k + 2].copy()
        estimate.step(stamp, DT if k else 0.0, 0, rows, NO_BIAS)
        assert run.accel_density[k] == estimate.motion[Parameter.ACCEL]
        np.testing.assert_array_equal(run.means[k], estimate.mean)
    assert run.accel_density[0] == pytest.approx(START)
    assert run.accel_density[280] < 0.7 * START


def test_a_copy_learns_for_itself() -> None:
    epochs = epochs_of(forklift(20.0))
    config = TrackerConfig()
    estimate = estimates.Estimate(config, T0, *pose_state(config, np.zeros(2), 100 * np.eye(2)))

    def onward(one: estimates.Estimate, first: int, end: int) -> float:
        for k in range(first, end):
            rows = epochs.rows[2 * k : 2 * k + 2].copy()
            one.step(int(epochs.stamps_ns[k]), DT, 0, rows, NO_BIAS)
        return one.accel_density

    kept = onward(estimate, 0, 100)
    twin = estimate.copy()
    moved = onward(twin, 100, 200)
    assert estimate.accel_density == kept != moved
    assert onward(estimate, 100, 200) == moved


@pytest.mark.parametrize(
    ("settings", "density"),
    [
        ({"accel_density_mps2_sqrthz": 0.3}, 0.3),
        ({"motion_model": "interacting"}, START),
        ({"filter": "kf"}, START),
    ],
)
def test_others_hold_theirs(settings: dict[str, object], density: float) -> None:
    config = TrackerConfig(**settings)  # type: ignore[arg-type]
    assert not config.learns_density
    estimate = estimates.Estimate(config, T0, *pose_state(config, np.zeros(2), np.eye(2)))
    epochs = epochs_of(forklift(5.0))
    for k in range(50):
        rows = epochs.rows[2 * k : 2 * k + 2].copy()
        estimate.step(int(epochs.stamps_ns[k]), DT, 0, rows, NO_BIAS)
        assert estimate.motion[Parameter.ACCEL] == density
    assert estimate.accel_density == density


def test_a_declared_density_holds_from_the_next_epoch_on() -> None:
    config = TrackerConfig()
    estimate = estimates.Estimate(config, T0, *pose_state(config, np.zeros(2), np.eye(2)))
    estimate.predict(T0 + 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == pytest.approx(START)
    estimate.set_config(replace(config, accel_density_mps2_sqrthz=0.7))
    estimate.predict(T0 + 2 * 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == estimate.accel_density == 0.7
    estimate.set_config(config)
    estimate.predict(T0 + 3 * 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == pytest.approx(START)


def test_steps_say_more_up_to_the_next_epoch() -> None:
    config = TrackerConfig()
    estimate = estimates.Estimate(config, T0, *pose_state(config, np.zeros(2), np.eye(2)))
    estimate.set_process_noise(0.05)
    estimate.predict(T0 + 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == 0.05
    estimate.predict(T0 + 2 * 10**8, NO_BIAS)
    assert estimate.motion[Parameter.ACCEL] == pytest.approx(START)
