"""What is behind an array that hears a device is cut off, against samples and in a track."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.estimation.mixture.gaussians import Mixture
from netpos.messages.values import AngleConvention, Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.estimates import cut_off_behind, start_from
from netpos.tracking.rsus.rsu import Rsu
from netpos.tracking.tracker import Tracker
from scipy.special import log_ndtr
from scipy.stats import norm, truncnorm

WALLS = {"west": (0.0, 0.0, 0.0), "north": (3.0, 3.0, -90.0), "south": (3.0, -3.0, 90.0)}
SD = 0.05


@pytest.mark.parametrize("ahead_m", [-3.0, -0.5, 0.0, 1.0])
def test_the_moments_are_those_of_the_samples_in_front(ahead_m: float) -> None:
    rng = np.random.default_rng(11)
    root = np.tril(rng.normal(0.0, 0.6, (7, 7))) + np.eye(7)
    origin, front = np.array([2.0, -1.0]), np.array([math.cos(0.7), math.sin(0.7)])
    mean, cov = rng.normal(0.0, 1.0, 7), root @ root.T
    mean[:2] = origin + ahead_m * front + 0.4 * np.array([-front[1], front[0]])
    samples = mean + rng.normal(size=(2_000_000, 7)) @ root.T
    kept = samples[(samples[:, :2] - origin) @ front > 0.0]
    cut_off_behind(mean, cov, origin, front)
    error_sd = np.sqrt(np.diag(np.cov(kept.T)) / len(kept))
    assert (np.abs(mean - kept.mean(axis=0)) < 5.0 * error_sd).all()
    np.testing.assert_allclose(cov, np.cov(kept.T), atol=0.05 * np.abs(cov).max())


def test_each_component_is_cut_and_counts_by_what_is_in_front() -> None:
    """One component is behind, one in front, and a third so far behind that it is out; then the
    mean is in front, and nothing more happens."""
    ahead, sd = np.array([-0.5, 1.0, -9.0]), 0.8
    means = np.zeros((3, 6))
    means[:, 0] = ahead
    covs = np.stack([sd**2 * np.eye(6)] * 3)
    estimate = start_from(TrackerConfig(), 0, Mixture(means, covs, np.log(np.full(3, 1.0 / 3.0))))
    estimate.keep_in_front(np.zeros(2), np.array([1.0, 0.0]))
    found = estimate.components
    share = norm.cdf(ahead[0] / sd)
    weights = np.exp(found.log_weights)
    np.testing.assert_allclose(weights[:2], np.array([share, 1.0]) / (share + 1.0), rtol=1e-9)
    assert weights[2] < 1e-20
    left = truncnorm(-ahead[0] / sd, np.inf, ahead[0], sd)
    np.testing.assert_allclose(found.means[:2, 0], [left.mean(), 1.0])
    np.testing.assert_allclose(found.covs[:2, 0, 0], [left.var(), sd**2])
    np.testing.assert_allclose(estimate.mean[0], weights @ found.means[:, 0])
    estimate.keep_in_front(np.zeros(2), np.array([1.0, 0.0]))
    np.testing.assert_array_equal(estimate.components.log_weights, found.log_weights)


@pytest.mark.parametrize(("ahead_sd", "cut"), [(-4.9, True), (-5.1, False), (-40.0, False)])
def test_what_contradicts_the_estimate_does_not_cut_it(ahead_sd: float, cut: bool) -> None:
    mean, cov = np.array([ahead_sd, 0.0, 1.0, 0.0, 0.0, 0.0]), np.eye(6)
    cut_off_behind(mean, cov, np.zeros(2), np.array([1.0, 0.0]))
    assert bool(mean[0] > 0.0) is cut
    assert bool(cov[0, 0] < 1.0) is cut
    assert np.linalg.eigvalsh(cov).min() > 0.0


@pytest.mark.parametrize("ahead_sd", [-200.0, -38.0, -5.0, -1.0, 0.0, 1e-9, 2.0, 9.0, 50.0])
def test_the_share_in_front_is_that_of_scipy(ahead_sd: float) -> None:
    mean, cov = np.array([ahead_sd, 0.0, 1.0, 0.0, 0.0, 0.0]), np.eye(6)
    share = cut_off_behind(mean, cov, np.zeros(2), np.array([1.0, 0.0]))
    assert share == pytest.approx(log_ndtr(ahead_sd), rel=1e-12, abs=1e-300)


def _info(name: str) -> RsuInfo:
    x, y, facing = WALLS[name]
    half = math.radians(facing) / 2.0
    return RsuInfo(
        rsu_id=name,
        position=np.array([x, y, 1.0]),
        quaternion=np.array([0.0, 0.0, math.sin(half), math.cos(half)]),
        angle_convention=AngleConvention.CONE,
    )


def _azimuth(info: RsuInfo, place: Array) -> float:
    along = Rsu.of(info).axes.reshape(3, 3)[1]
    offset = place - info.position
    return math.asin(float(along @ offset) / float(np.linalg.norm(offset)))


def test_a_device_is_not_behind_the_wall_of_an_array_that_hears_it() -> None:
    """Two arrays with an error see it half a metre behind the wall of the third."""
    infos = [_info(name) for name in WALLS]
    tracker = Tracker(TrackerConfig(device_height_m=1.0, gate_probability=1.0, isolate_rsus=False))
    for info in infos:
        tracker.add_rsu(info)
    places = []
    for k in range(100):
        for info in infos:
            seen = 0.3 if info.rsu_id == "west" else max(1.5 - 0.03 * k, -0.5)
            tracker.add(
                RsuMeasurement(
                    stamp_ns=1_000_000_000 + 100_000_000 * k,
                    rsu_id=info.rsu_id,
                    vue_id="vue_1",
                    sequence=k,
                    expected=3,
                    fields=Field.AZIMUTH,
                    azimuth_rad=_azimuth(info, np.array([seen, 0.0, 1.0])),
                    azimuth_var=SD**2,
                )
            )
        places += [o.odometry.position[0] for o in tracker.process() if o.odometry is not None]
    assert len(places) > 80
    assert min(places) > 0.0
