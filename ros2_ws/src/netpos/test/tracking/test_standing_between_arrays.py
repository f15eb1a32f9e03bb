"""A person who stands between arrays, the angles of which are off as long as she stands."""

from __future__ import annotations

import math

import numpy as np
import pytest
from error_cases import Case, Measures, run
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.tracker import Tracker
from scipy.stats import chi2

CORNERS = np.array([[0.0, 0.0, 2.5], [12.0, 0.0, 2.5], [12.0, 8.0, 2.5], [0.0, 8.0, 2.5]])
BIAS_SD, NOISE_SD = math.radians(8.0), math.radians(5.0)
S = 1_000_000_000


def a_place(rng: np.random.Generator) -> Array:
    return np.array([rng.uniform(2.0, 10.0), rng.uniform(1.5, 6.5), 1.2])


def on_a_grid(seed: int) -> float:
    """Squared error [m^2] of the mean of the exact posterior of one angle of each array, whose
    biases nobody knows."""
    rng = np.random.default_rng(seed)
    place = a_place(rng)
    x, y = np.meshgrid(np.linspace(-10.0, 22.0, 161), np.linspace(-10.0, 18.0, 141))
    log = np.zeros_like(x)
    for corner in CORNERS:
        off = rng.normal(0.0, BIAS_SD)
        off += np.arctan2(*(place - corner)[[1, 0]]) - np.arctan2(y - corner[1], x - corner[0])
        log -= 0.5 * (np.remainder(off + math.pi, 2 * math.pi) - math.pi) ** 2 / BIAS_SD**2
    weights = np.exp(log - log.max())
    mean = np.array([(weights * x).sum(), (weights * y).sum()]) / weights.sum()
    return float(((mean - place[:2]) ** 2).sum())


def stands(seed: int, seconds: float, lasts_s: float) -> tuple[Array, Array]:
    """Errors (n, 2) [m] and NEES (n,) of someone who stands, an epoch each half second, between
    arrays whose biases last ``lasts_s``."""
    rng = np.random.default_rng(seed)
    place = a_place(rng)
    config = TrackerConfig(
        manoeuvre_speed_sd_mps=0.0,
        device_height_m=1.2,
        accel_density_mps2_sqrthz=0.2,
        initial_speed_sd_mps=0.5,
        gate_probability=1.0,
    )
    tracker = Tracker(config)
    for i, corner in enumerate(CORNERS):
        tracker.add_rsu(
            RsuInfo(
                rsu_id=f"a{i}",
                position=corner,
                azimuth_bias_sd_rad=BIAS_SD,
                bias_correlation_time_s=lasts_s,
            )
        )
    true = np.arctan2(*(place - CORNERS)[:, [1, 0]].T)
    bias, decay = rng.normal(0.0, BIAS_SD, 4), math.exp(-0.5 / lasts_s)
    errors, nees = [], []
    for k in range(round(2 * seconds)):
        bias = decay * bias + rng.normal(0.0, BIAS_SD * math.sqrt(1 - decay**2), 4)
        for i, angle in enumerate(true + bias + rng.normal(0.0, NOISE_SD, 4)):
            tracker.add(
                RsuMeasurement(
                    stamp_ns=S + k * S // 2,
                    rsu_id=f"a{i}",
                    vue_id="v",
                    sequence=k,
                    expected=4,
                    fields=Field.AZIMUTH,
                    azimuth_rad=math.remainder(angle, 2 * math.pi),
                    azimuth_var=NOISE_SD**2,
                )
            )
        for output in tracker.process():
            if output.odometry is not None:
                error = output.odometry.position[:2] - place[:2]
                errors.append(error)
                cov = output.odometry.pose_cov[:2, :2]
                nees.append(float(error @ np.linalg.solve(cov, error)))
    return np.array(errors), np.array(nees)


@pytest.mark.parametrize("lasts_s", [100.0, 1e6])
def test_person_who_stands_is_not_placed_more_surely_than_the_angles_allow(
    lasts_s: float,
) -> None:
    runs = 30
    found = [stands(seed, 60.0, lasts_s) for seed in range(runs)]
    assert all(len(nees) > 100 for _, nees in found)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 2 * runs) / runs
    for second in (10, 30, 58):
        mean_nees = np.mean([nees[2 * second] for _, nees in found])
        assert low < mean_nees < high
    rmse = math.sqrt(np.mean([(errors[20:] ** 2).sum(axis=1).mean() for errors, _ in found]))
    assert rmse < 1.25 * math.sqrt(np.mean([on_a_grid(seed) for seed in range(200)]))


def test_minute_of_the_same_values_tells_nothing() -> None:
    """Four arrays in a room, the direction cosines of which are off by 0.22 for ever: once the
    noise is averaged out, neither place nor covariance has a reason to change."""
    room = Case(
        variance=0.1, bias=2.5, rsus=4, measures=Measures.COSINES, time_s=math.inf, moving=False
    )
    runs = [run(room, seed, told=True, learn=False) for seed in range(700, 708)]
    errors = np.array([np.linalg.norm(r.means - r.places, axis=1) for r in runs])
    sd = np.array([np.sqrt(np.trace(r.covs, axis1=1, axis2=2)) for r in runs])
    early, late = slice(100, 200), slice(700, 900)  # 10 Hz
    assert np.sqrt((errors[:, late] ** 2).mean()) < 1.2 * np.sqrt((errors[:, early] ** 2).mean())
    assert sd[:, late].mean() > 0.8 * sd[:, early].mean()
