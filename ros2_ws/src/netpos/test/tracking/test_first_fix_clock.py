"""A first fix by times of arrival of a clock of which nobody knows how it walks."""

from __future__ import annotations

import math

import numpy as np
import pytest
from first_fix import at, measure, rsu
from netpos.estimation.measurement import GROUP, VALUE
from netpos.estimation.mixture.gaussians import moments
from netpos.messages.values import Array, Field
from netpos.tracking import TrackerConfig
from netpos.tracking.first_fix.initialise import Initialiser
from netpos.tracking.rsus.rsu import Rsu
from scipy.constants import speed_of_light
from scipy.optimize import least_squares
from scipy.stats import chi2
from track_cases import T0

SD_M, STEP_NS, SEEDS = 0.3, 200_000_000, 12
STATIONS = [rsu(0, 0), rsu(40, 0), rsu(0, 40), rsu(40, 45), rsu(-15, 20)]
STILL = TrackerConfig(initial_speed_sd_mps=0.01, accel_density_mps2_sqrthz=1e-3)


def epochs(place: Array, clocks_m: Array, stations: list[Rsu], rng: np.random.Generator) -> Array:
    """Times [m] (epochs, stations) that a device measures which stands at ``place``."""
    sites = np.array([s.info.position[:2] for s in stations])
    distance = np.hypot(*(place - sites).T)
    noise: Array = SD_M * rng.normal(size=(len(clocks_m), len(stations)))
    return distance + clocks_m[:, None] + noise


def first_fix(times_m: Array, stations: list[Rsu], config: TrackerConfig = STILL) -> Initialiser:
    """What collected all of the times."""
    initialiser = Initialiser(config)
    for k, values in enumerate(times_m):
        rows = np.vstack([measure(s, at(0.0, 0.0), Field.TOA) for s in stations])
        rows[:, VALUE], rows[:, GROUP] = values, np.arange(len(stations))
        initialiser.add(T0 + k * STEP_NS, rows, tuple(stations))
    return initialiser


@pytest.mark.parametrize("seed", range(5))
def test_a_clock_that_is_anything_at_each_instant_is_left_out(seed: int) -> None:
    """The place is the one at which the times of each instant differ as measured: SciPy's."""
    rng = np.random.default_rng(seed)
    place, clocks_m = rng.uniform(5.0, 35.0, 2), 30.0 * rng.normal(size=10)
    times_m = epochs(place, clocks_m, STATIONS, rng)
    found = first_fix(times_m, STATIONS).solve()
    assert found is not None
    mean, cov = moments(found)
    sites = np.array([s.info.position[:2] for s in STATIONS])

    def misfit(xy: Array) -> Array:
        left = times_m - np.hypot(*(xy - sites).T)
        return (left - left.mean(axis=1, keepdims=True)).ravel() / SD_M

    expected = least_squares(misfit, place)
    np.testing.assert_allclose(mean[:2], expected.x, atol=0.02)
    expected_cov = np.linalg.inv(expected.jac.T @ expected.jac)
    np.testing.assert_allclose(cov[:2, :2], expected_cov, rtol=0.1, atol=1e-4)


def test_a_clock_that_is_told_to_be_steady_is_not_left_out() -> None:
    """Whoever declares the walk of a clock that jumps is told that the times contradict."""
    rng = np.random.default_rng(1)
    times_m = epochs(np.array([20.0, 15.0]), 30.0 * rng.normal(size=10), STATIONS, rng)
    declared = TrackerConfig(
        initial_speed_sd_mps=0.01,
        accel_density_mps2_sqrthz=1e-3,
        clock_walk_density=1e-12,
        initial_position_sd_max_m=0.3,
    )
    initialiser = first_fix(times_m, STATIONS, declared)
    assert initialiser.solve() is None
    assert "contradict each other" in initialiser.missing


def test_times_of_one_rsu_at_a_time_leave_the_clock_on_its_line() -> None:
    """Nothing could be said of the place if the clock were anything: here it is on a line."""
    rng, place = np.random.default_rng(2), np.array([20.0, 15.0])
    times_m = epochs(place, np.zeros(15), STATIONS, rng)
    initialiser = Initialiser(STILL)
    for k in range(15):
        station = STATIONS[k % 5]
        row = measure(station, at(0.0, 0.0), Field.TOA)
        row[0, VALUE] = times_m[k, k % 5] + (40.0 if k == 7 else 0.0)
        initialiser.add(T0 + k * STEP_NS, row, (station,))
    found = initialiser.solve()
    assert found is not None
    assert np.hypot(*(moments(found)[0][:2] - place)) < 2.0


@pytest.mark.parametrize("walk", [1e-9, 1e-7, 1e-6])
def test_fixes_are_as_wrong_as_they_say_however_the_clock_walks(walk: float) -> None:
    """Four RSUs beside each other, so far away that one instant does not suffice: how the clock
    goes on decides how far away the device is."""
    stations = [rsu(-12, 0), rsu(-4, 3), rsu(5, 0), rsu(12, 2)]
    nees = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        place = rng.uniform((-10.0, 25.0), (10.0, 40.0))
        drift_mps = 3.0 * rng.normal() + speed_of_light * walk * math.sqrt(0.2) * np.cumsum(
            rng.normal(size=15)
        )
        times_m = epochs(place, 20.0 * rng.normal() + 0.2 * np.cumsum(drift_mps), stations, rng)
        for count in range(1, 16):
            found = first_fix(times_m[:count], stations).solve()
            if found is not None:
                break
        assert found is not None
        mean, cov = moments(found)
        off = mean[:2] - place
        nees.append(float(off @ np.linalg.solve(cov[:2, :2], off)))
    assert sum(nees) < chi2.ppf(0.999, 2 * SEEDS)
