"""A first fix allows for one RSU that errs grossly: its mixture against the posterior on a grid,
and its level."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from first_fix import at, fix_of, measure, rsu
from netpos.estimation.measurement import VALUE
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.first_fix.initialise import Initialiser
from netpos.tracking.report import TrackOutput
from netpos.tracking.tracker import Tracker
from scipy.constants import speed_of_light
from scipy.stats import multivariate_normal, norm
from track_cases import T0

SD_M = 0.3
ERRS, GROSS_SD = 0.01, 30.0
SITES = ((0.0, 0.0), (40.0, 0.0), (0.0, 40.0), (45.0, 50.0), (-30.0, 20.0))
PLACE = np.array([12.0, 25.0])
STILL = {"initial_speed_sd_mps": 1e-3, "initial_position_sd_max_m": 50.0}


def grid(log_density: Callable[[Array], Array], half_m: float) -> tuple[Array, Array]:
    """Mean and covariance of a density about ``PLACE``."""
    steps = np.linspace(-half_m, half_m, 1001)
    places = PLACE + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    logs = log_density(places)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = weights @ places
    away = places - mean
    return mean, (away * weights[:, None]).T @ away


def distances(places: Array, sites: int) -> Array:
    return np.linalg.norm(places[:, None, :] - np.array(SITES[:sites]), axis=-1)


@pytest.mark.parametrize("sites", [3, 4])
@pytest.mark.parametrize("late_sd", [0.0, 2.5])
def test_ranges_of_which_one_may_be_wrong(sites: int, late_sd: float) -> None:
    """With four ranges two are to spare, and the wrong one shows; with three it hardly does."""
    config = TrackerConfig(**STILL)
    stations = [rsu(*site) for site in SITES[:sites]]
    rows = np.vstack(
        [measure(s, at(*PLACE), Field.RANGE, group=i) for i, s in enumerate(stations)]
    )
    rows[1, VALUE] += late_sd * SD_M
    seen = distances(PLACE[None], sites)[0]
    seen[1] += late_sd * SD_M
    np.testing.assert_allclose(rows[:, VALUE], seen)
    initialiser = Initialiser(config)
    initialiser.add(T0, rows, tuple(stations))
    fix = fix_of(initialiser)
    assert fix is not None

    def log_density(places: Array) -> Array:
        residuals = seen - distances(places, sites)
        right = norm.logpdf(residuals, scale=SD_M)
        wrong = norm.logpdf(residuals, scale=SD_M * math.hypot(1.0, GROSS_SD))
        cases = [right.sum(axis=1)]
        cases += [
            math.log(ERRS) + right.sum(axis=1) - right[:, j] + wrong[:, j] for j in range(sites)
        ]
        middle = np.mean(SITES[:sites], axis=0)
        prior = norm.logpdf(places - middle, scale=config.coverage_radius_m).sum(axis=1)
        return np.asarray(np.logaddexp.reduce(cases) + prior)

    mean, cov = grid(log_density, 25.0)
    sd = math.sqrt(np.trace(cov))
    np.testing.assert_allclose(fix[0][:2], mean, atol=0.05 * sd)
    np.testing.assert_allclose(fix[1][:2, :2], cov, rtol=0.1, atol=0.02 * sd**2)


def differences(late_m: Array) -> list[RsuMeasurement]:
    """Differences of all others to the first of ``SITES``, of arrivals ``late_m`` late."""
    arrivals = distances(PLACE[None], len(late_m))[0] + late_m
    return [
        RsuMeasurement(
            stamp_ns=T0,
            rsu_id=str(i),
            vue_id="v",
            expected=len(late_m) - 1,
            fields=Field.TDOA,
            reference_rsu_id="0",
            tdoa_s=(arrivals[i] - arrivals[0]) / speed_of_light,
            tdoa_var=2.0 * (SD_M / speed_of_light) ** 2,
        )
        for i in range(1, len(late_m))
    ]


def first_output(late_m: Array, *, allows: bool) -> TrackOutput:
    tracker = Tracker(TrackerConfig(**STILL, isolate_rsus=allows))
    for i, site in enumerate(SITES[: len(late_m)]):
        tracker.add_rsu(RsuInfo(rsu_id=str(i), position=np.array([*site, 0.0])))
    for item in differences(late_m):
        assert tracker.add(item) is None
    (said,) = tracker.process()
    return said


@pytest.mark.parametrize("wrong", [0, 1, 3])
def test_the_reference_of_differences_may_be_wrong(wrong: int) -> None:
    """Its error is in all of them, as a clock's would be."""
    late_m = np.zeros(len(SITES))
    late_m[wrong] = 3.0 * SD_M
    said = first_output(late_m, allows=True)
    assert said.odometry is not None

    count = len(SITES) - 1
    seen = distances(PLACE[None], len(SITES))[0] + late_m
    white = SD_M**2 * (np.eye(count) + np.ones((count, count)))
    gross = (GROSS_SD * SD_M) ** 2
    wrongs = [gross * np.diag(np.eye(count)[j]) for j in range(count)]
    wrongs.append(gross * np.ones((count, count)))

    def log_density(places: Array) -> Array:
        far = distances(places, len(SITES))
        residuals = (seen[1:] - seen[0]) - (far[:, 1:] - far[:, :1])
        cases = [multivariate_normal.logpdf(residuals, cov=white)]
        cases += [
            math.log(ERRS) + multivariate_normal.logpdf(residuals, cov=white + more)
            for more in wrongs
        ]
        return np.asarray(np.logaddexp.reduce(cases))

    mean, cov = grid(log_density, 25.0)
    sd = math.sqrt(np.trace(cov))
    np.testing.assert_allclose(said.odometry.position[:2], mean, atol=0.05 * sd)
    np.testing.assert_allclose(said.odometry.pose_cov[:2, :2], cov, rtol=0.1, atol=0.02 * sd**2)


@pytest.mark.parametrize("wrong", [0, 2])
@pytest.mark.parametrize("allows", [True, False])
def test_the_level_of_a_first_fix_holds_a_wrong_rsu(wrong: int, allows: bool) -> None:
    """One of three receivers is 10 sd late, and nothing shows it. Who takes for granted that no
    RSU is wrong has a level that is smaller than the error."""
    late_m = np.zeros(3)
    late_m[wrong] = 10.0 * SD_M
    said = first_output(late_m, allows=allows)
    assert said.odometry is not None
    error_m = float(np.linalg.norm(said.odometry.position[:2] - PLACE))
    assert (error_m < said.status.protection_level_m) is allows
