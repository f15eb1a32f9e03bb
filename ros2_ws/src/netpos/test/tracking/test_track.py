"""One track: convergence, consistency, start."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.estimation.state import X
from netpos.messages.values import (
    Array,
    Field,
    TrackState,
)
from netpos.tracking import TrackOutput
from netpos.tracking.estimators.models import gate_thresholds
from scipy.constants import speed_of_light
from scipy.stats import chi2
from track_cases import T0, error, pose, standing, straight

ALL = Field.AZIMUTH | Field.TOA


def map_velocity(output: TrackOutput) -> Array:
    assert output.odometry is not None
    z, w = output.odometry.quaternion[2:]
    yaw = 2.0 * math.atan2(z, w)
    v = output.odometry.linear_velocity
    return np.array(
        [math.cos(yaw) * v[0] - math.sin(yaw) * v[1], math.sin(yaw) * v[0] + math.cos(yaw) * v[1]]
    )


def test_straight_run_converges_in_position_velocity_and_clock(world: Any, feed: Any) -> None:
    world.rng = np.random.default_rng(1)
    tracker = world.tracker()
    outputs = []
    for k in range(120):
        truth = straight(0.1 * k, 6000.0, 7500.0)
        outputs += feed(tracker, world.measure(0.1 * k, truth))
    assert len(outputs) == 120
    truth = straight(11.9, 6000.0, 7500.0)
    assert error(outputs[-1], truth) < 0.5
    np.testing.assert_allclose(map_velocity(outputs[-1]), [8.0, 0.0], atol=0.6)
    clock = outputs[-1].clock
    assert clock is not None
    assert abs(clock.offset_s * speed_of_light - truth[X.CLOCK]) < 1.0
    assert abs(clock.drift * speed_of_light - 7500.0) < 30.0
    assert (
        abs(clock.offset_s * speed_of_light - truth[X.CLOCK])
        < 4 * math.sqrt(clock.cov[0, 0]) * speed_of_light
    )
    status = outputs[-1].status
    assert status.state is TrackState.TRACKING
    assert status.sources == ("a", "b", "c")
    assert (status.used, status.accepted) == (3, 360)
    assert status.nis_dof == 6
    assert status.rejected == {}
    cov = outputs[-1].odometry.pose_cov[:2, :2]
    assert status.position_sd_m == pytest.approx(math.sqrt(np.linalg.eigvalsh(cov)[-1]))
    mean_nis = np.mean([o.status.nis for o in outputs if o.status.nis_dof])
    assert mean_nis == pytest.approx(6.0, abs=4 * math.sqrt(2 * 6 / 119))


@pytest.mark.parametrize(
    ("fields", "limit"),
    [(Field.POSITION, 0.3), (Field.AZIMUTH, 1.0), (Field.RANGE, 0.5), (Field.TOA, 1.0)],
)
def test_one_kind_of_measurement_is_enough(
    world: Any, feed: Any, fields: Field, limit: float
) -> None:
    world.rng = np.random.default_rng(2)
    tracker = world.tracker()
    for k in range(60):
        truth = straight(2.0 + 0.1 * k)
        outputs = feed(tracker, world.measure(2.0 + 0.1 * k, truth, fields))
    assert error(outputs[-1], truth) < limit
    assert (outputs[-1].clock is not None) is (fields is Field.TOA)


def model_track(seed: int, F: Array, Q: Array) -> list[Array]:
    """Truth drawn from the tracker's own model: 25 states, 0.2 s apart."""
    rng = np.random.default_rng(seed)
    state = np.array([30.0, 0.0, 0.0, 0.0, 0.0, 0.0]) + rng.normal(size=6) * [2, 2, 3, 3, 30, 9]
    states = []
    w, V = np.linalg.eigh(Q)
    root = V * np.sqrt(np.maximum(w, 0.0))
    for _ in range(25):
        state = F @ state + root @ rng.normal(size=6)
        states.append(state)
    return states


@pytest.mark.parametrize("filter_name", ["ekf", "iekf", "ukf", "srukf"])
@pytest.mark.parametrize("kind", ["continuous", "werner", "white_acceleration"])
def test_covariance_is_consistent_when_truth_follows_the_model(
    world: Any, feed: Any, matrices: Any, kind: str, filter_name: str
) -> None:
    """Mean NEES of position, velocity and clock at the last epoch of 60 runs, in its bounds."""
    c, runs, nees = speed_of_light, 60, []
    config = {
        "filter": filter_name,
        "process_noise": kind,
        "accel_density_mps2_sqrthz": 0.8,
        "accel_sd_mps2": 0.8,
        "velocity_step_sd_mps": 0.4,
        "clock_white_density": 0.05 / c,
        "clock_walk_density": 0.5 / c,
        "drift_step_sd": 0.3 / c,
        "initial_speed_sd_mps": 3.0,
        "clock_offset_sd_s": 30.0 / c,
        "clock_drift_mean": 0.0,
        "clock_drift_sd": 9.0 / c,
        "gate_probability": 1.0,
    }
    for seed in range(runs):
        states = model_track(seed, *matrices(kind, 0.2, 0.8, 0.4, 0.05, 0.5, 0.3))
        tracker = world.tracker(**config)
        world.rng = np.random.default_rng(10_000 + seed)
        feed(tracker, [pose(0.0, 30.0, 0.0, 4.0)])
        for k, state in enumerate(states):
            feed(tracker, world.measure(0.2 * (k + 1), state))
        estimate = tracker._tracks["vue_1"]._state.estimator.estimate
        e = estimate.mean - states[-1]
        nees.append(e @ np.linalg.solve(estimate.cov, e))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * runs) / runs
    assert low < np.mean(nees) < high


def test_waiting_then_initialising_then_tracking(world: Any, feed: Any) -> None:
    tracker = world.tracker()
    (output,) = feed(tracker, world.measure(0.0, straight(0.0), Field.RANGE, ["a"]))
    assert (output.odometry, output.clock) == (None, None)
    assert output.status.state is TrackState.WAITING
    assert (output.status.used, output.status.accepted, output.status.position_sd_m) == (0, 0, 0.0)
    (output,) = feed(tracker, world.measure(0.1, straight(0.1)))
    assert output.status.state is TrackState.TRACKING
    assert (output.status.used, output.status.nis_dof) == (3, 0)  # a fit has no innovation
    assert output.status.nis == 0.0
    assert output.status.sources == ("a", "b", "c")
    (output,) = feed(world.tracker(), [pose(0.0, 0.0, 0.0, 5.01**2)])
    assert output.status.state is TrackState.INITIALISING
    (output,) = feed(world.tracker(), [pose(0.0, 0.0, 0.0, 4.99**2)])
    assert output.status.state is TrackState.TRACKING


@pytest.mark.parametrize("fields", [ALL, Field.RANGE | Field.AZIMUTH])
def test_clock_is_reported_from_the_first_toa_on(world: Any, feed: Any, fields: Field) -> None:
    tracker = world.tracker()
    (output,) = feed(tracker, world.measure(0.0, standing(), fields))
    assert output.odometry is not None
    assert (output.clock is not None) is bool(fields & Field.TOA)
    (output,) = feed(tracker, world.measure(0.1, standing(), ALL))
    assert output.clock is not None
    (output,) = feed(tracker, world.measure(0.2, standing(), Field.RANGE))
    assert output.clock is not None


def posterior_sd_m(sites: Array, own_m: float, shared_m: float) -> float:
    """Of the position where it is widest, given ranges from ``standing()`` without noise whose
    errors have the sd ``own_m`` each and ``shared_m`` together: summed on a grid, under a prior of
    150 m about the middle of the RSUs."""
    axis = np.arange(-15.0, 15.0, 0.05)
    xy = np.stack(np.meshgrid(axis + 40.0, axis + 2.0, indexing="ij"), axis=-1)
    true_m = np.linalg.norm(sites - [40.0, 2.0], axis=1)
    left = np.linalg.norm(xy[..., None, :] - sites, axis=-1) - true_m
    weigh = np.linalg.inv(own_m**2 * np.eye(len(sites)) + shared_m**2)
    cost = np.einsum("ijk,kl,ijl->ij", left, weigh, left)
    cost += (np.square(xy - sites.mean(axis=0)) / 150.0**2).sum(axis=-1)
    weight = (
        np.exp(-0.5 * (cost - cost.min()))[..., None] / np.exp(-0.5 * (cost - cost.min())).sum()
    )
    away = xy - (weight * xy).sum(axis=(0, 1))
    cov = np.einsum("ij,ijk,ijl->kl", weight[..., 0], away, away)
    return math.sqrt(float(np.linalg.eigvalsh(cov)[-1]))


def test_first_fix_knows_of_the_biases(world: Any, feed: Any) -> None:
    """Own bias 0.4 m and common bias 1.2 m on 0.3 m of noise: the common one moves all ranges
    alike."""
    all_right = {"isolate_rsus": False}
    sites = np.array([info.position[:2] for info in world.rsus.values()])
    (plain,) = feed(world.tracker(**all_right), world.measure(0.0, standing(), Field.RANGE))
    assert plain.status.position_sd_m == pytest.approx(posterior_sd_m(sites, 0.3, 0.0), rel=0.01)
    with_errors(
        world,
        range_bias_sd_m=0.4,
        bias_correlation_time_s=9.0,
        common_range_bias_sd_m=1.2,
        common_bias_correlation_time_s=9.0,
    )
    (biased,) = feed(world.tracker(**all_right), world.measure(0.0, standing(), Field.RANGE))
    assert biased.status.position_sd_m == pytest.approx(posterior_sd_m(sites, 0.5, 1.2), rel=0.02)


def test_initial_pose_starts_the_track_as_the_paper_does(world: Any, feed: Any) -> None:
    """fokin2020:eq.32, 33: position given, velocity 0, clock 0, drift 25 ppm."""
    tracker = world.tracker()
    p = replace(pose(0.0, 3.0, 4.0), cov=np.array([[4.0, 1.0, 0], [1.0, 9.0, 0], [0, 0, 1.0]]))
    (output,) = feed(tracker, [p])
    assert output.status.stamp_ns == T0
    assert (output.status.used, output.status.accepted) == (0, 0)
    estimate = tracker._tracks["vue_1"]._state.estimator.estimate
    c = speed_of_light
    np.testing.assert_allclose(estimate.mean, [3.0, 4.0, 0, 0, 0, 25e-6 * c])
    expected = np.diag([4.0, 9.0, 25.0, 25.0, (1e-4 * c) ** 2, (30e-6 * c) ** 2])
    expected[0, 1] = expected[1, 0] = 1.0
    np.testing.assert_allclose(estimate.cov, expected, rtol=1e-12)


def test_initial_pose_replaces_a_running_track(world: Any, feed: Any) -> None:
    tracker = world.tracker()
    for k in range(5):
        feed(tracker, world.measure(0.1 * k, straight(0.1 * k)))
    (output,) = feed(tracker, [pose(0.5, 4.5, -0.5)])
    np.testing.assert_allclose(output.odometry.position, [4.5, -0.5, 0.0])
    assert output.clock is None
    assert output.status.accepted == 15


def test_pose_and_measurements_of_one_stamp_pose_first(world: Any, feed: Any) -> None:
    tracker = world.tracker()
    items = [*world.measure(0.0, standing(41.0, 2.0)), pose(0.0, 40.0, 2.0)]
    (output,) = feed(tracker, items)
    assert output.status.used == 3
    assert output.status.nis_dof == 6
    assert 40.0 < output.odometry.position[0] < 41.1


def test_require_initial_pose_waits_after_no_reset_but_the_first(world: Any, feed: Any) -> None:
    """Once measurements have been accepted a lost track finds itself again."""
    tracker = world.tracker(require_initial_pose=True, max_gap_s=1.0)
    feed(tracker, [pose(0.0, 40.0, 2.0)])
    feed(tracker, world.measure(0.1, standing()))
    (output,) = feed(tracker, world.measure(9.0, standing()))
    assert output.odometry is not None
    assert "no_initial_pose" not in output.status.rejected


def test_gate_thresholds_are_chi_square_quantiles() -> None:
    t = gate_thresholds(0.95)
    np.testing.assert_allclose(t[:4], [0.0, 3.841459, 5.991465, 7.814728], atol=1e-6)
    assert len(t) == 65
    assert np.isinf(gate_thresholds(1.0)[1:]).all()


def with_errors(world: Any, **change: Any) -> None:
    world.rsus = {n: replace(info, **change) for n, info in world.rsus.items()}
