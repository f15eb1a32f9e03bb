"""One track: process noise, velocities, sensor biases, heading."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.estimation.state import POSITION, VELOCITY
from netpos.messages.values import (
    Array,
    Field,
    GroundSpeed,
    RsuInfo,
    TrackState,
    Velocity,
)
from netpos.tracking import TrackOutput
from scipy.constants import speed_of_light
from scipy.stats import chi2
from track_cases import KNOWN_CLOCK, T0, error, pose, standing, straight

ALL = Field.AZIMUTH | Field.TOA


STILL = {"accel_density_mps2_sqrthz": 1e-6}


def velocity(t_s: float, v: tuple[float, float], var: float = 0.01, **change: Any) -> Velocity:
    values = {"stamp_ns": T0 + round(t_s * 1e9), "vue_id": "vue_1"}
    return Velocity(velocity=np.array(v), cov=var * np.eye(2), **(values | change))


def map_velocity(output: TrackOutput) -> Array:
    assert output.odometry is not None
    z, w = output.odometry.quaternion[2:]
    yaw = 2.0 * math.atan2(z, w)
    v = output.odometry.linear_velocity
    return np.array(
        [math.cos(yaw) * v[0] - math.sin(yaw) * v[1], math.sin(yaw) * v[0] + math.cos(yaw) * v[1]]
    )


def settled(world: Any, feed: Any, fields: Field = ALL, **config: Any) -> Any:
    tracker = world.tracker(**(STILL | config))
    for k in range(20):
        feed(tracker, world.measure(0.1 * k, standing(), fields))
    return tracker


def predicted(track: Any, stamp_ns: int) -> Any:
    """The estimate of a track at a later stamp; the track stays where it is."""
    ahead = track._state.estimator.estimate.copy()
    ahead.predict(stamp_ns, track._state.estimator.bias)
    return ahead


def test_prediction_between_measurements_is_the_model(
    world: Any, feed: Any, matrices: Any
) -> None:
    tracker = settled(world, feed, accel_density_mps2_sqrthz=0.7, clock_walk_density=2.5e-7)
    track = tracker._tracks["vue_1"]
    now = track._state.estimator.estimate
    ahead = predicted(track, T0 + 2_400_000_000)
    c = speed_of_light
    F, Q = matrices("continuous", 0.5, 0.7, 1e9, 1e-10 * c, 2.5e-7 * c, 1e9)
    np.testing.assert_allclose(ahead.mean, F @ now.mean, rtol=1e-12)
    np.testing.assert_allclose(ahead.cov, F @ now.cov @ F.T + Q, rtol=1e-9, atol=1e-12)
    assert ahead.stamp_ns == T0 + 2_400_000_000
    same = predicted(track, now.stamp_ns)
    np.testing.assert_array_equal(same.cov, now.cov)


@pytest.mark.parametrize(
    ("kind", "args"),
    [
        ("werner", (1e9, 0.3, 1e9, 1e9, 0.02)),
        ("white_acceleration", (0.6, 1e9, 1e9, 1e9, 0.02)),
    ],
)
def test_each_process_noise_takes_its_own_parameters(
    world: Any, feed: Any, matrices: Any, kind: str, args: tuple[float, ...]
) -> None:
    tracker = world.tracker(
        process_noise=kind,
        accel_sd_mps2=0.6,
        accel_density_mps2_sqrthz=77.0,
        velocity_step_sd_mps=0.3,
        drift_step_sd=0.02 / speed_of_light,
    )
    feed(tracker, [pose(0.0, 0.0, 0.0)])
    track = tracker._tracks["vue_1"]
    F, Q = matrices(kind, 0.5, *args)
    ahead = predicted(track, T0 + 500_000_000)
    before = track._state.estimator.estimate.cov
    np.testing.assert_allclose(ahead.cov - F @ before @ F.T, Q, rtol=1e-5, atol=1e-5)


def test_step_velocity_is_fused_as_the_equations_say(world: Any, feed: Any) -> None:
    tracker = world.tracker(**STILL)
    feed(tracker, [pose(0.0, 0.0, 0.0)])
    cov = np.array([[0.09, 0.03], [0.03, 0.04]])
    item = replace(velocity(0.0, (1.0, -2.0)), cov=cov, stamp_ns=T0)
    (output,) = feed(tracker, [item])
    P = np.eye(2) * 25.0
    K = P @ np.linalg.inv(P + cov)
    np.testing.assert_allclose(map_velocity(output), K @ [1.0, -2.0], rtol=1e-9)
    estimate = tracker._tracks["vue_1"]._state.estimator.estimate
    np.testing.assert_allclose(estimate.cov[VELOCITY, VELOCITY], P - K @ P, rtol=1e-8, atol=1e-10)
    assert output.status.sources == ("step_velocity",)
    assert output.status.nis_dof == 2


def test_ground_speed_is_fused_along_the_motion(world: Any, feed: Any) -> None:
    tracker = world.tracker(filter="ekf", **STILL)
    feed(tracker, [pose(0.0, 0.0, 0.0), velocity(0.0, (3.0, 4.0), 0.25)])
    before = tracker._tracks["vue_1"]._state.estimator.estimate.copy()
    v = before.mean[VELOCITY]
    u = v / np.linalg.norm(v)
    # 1 ns later: in the same epoch it would be linearised at rest
    s = GroundSpeed(stamp_ns=T0 + 1, vue_id="vue_1", speed_mps=5.5, speed_var=0.04)
    (output,) = feed(tracker, [s])
    P = before.cov[VELOCITY, VELOCITY]
    K = P @ u / (u @ P @ u + 0.04)
    np.testing.assert_allclose(map_velocity(output), v + K * (5.5 - np.linalg.norm(v)), rtol=1e-6)
    assert output.status.sources == ("ground_speed",)
    assert output.status.nis_dof == 1


def test_velocities_bridge_an_outage(world: Any, feed: Any) -> None:
    tracker = world.tracker(max_gap_s=100.0)
    for k in range(20):
        feed(tracker, world.measure(0.1 * k, straight(0.1 * k)))
    for k in range(20, 120):
        (output,) = feed(tracker, [velocity(0.1 * k, (8.0, 0.0))])
    assert error(output, straight(11.9)) < 1.0
    assert output.status.state is TrackState.TRACKING
    assert output.status.position_sd_m < 1.5


def with_errors(world: Any, **change: Any) -> None:
    world.rsus = {n: replace(info, **change) for n, info in world.rsus.items()}


def test_bias_states_find_simulated_biases(world: Any, feed: Any) -> None:
    """Two RSUs without, one with a range bias of 2 m: the state of that one shows it."""
    with_errors(world, range_bias_sd_m=1.0, bias_correlation_time_s=1e4)
    for name in "ab":
        world.rsus[name] = replace(world.rsus[name], range_bias_sd_m=0.001)
    world.rsus["d"] = RsuInfo(
        rsu_id="d",
        position=np.array([0.0, 60.0, 0.0]),
        range_bias_sd_m=0.001,
        bias_correlation_time_s=1e4,
    )
    world.biases = {"c": 2.0}
    world.rng = np.random.default_rng(4)
    tracker = world.tracker()
    for k in range(100):
        (output,) = feed(tracker, world.measure(0.1 * k, straight(0.1 * k), Field.RANGE))
    estimate = tracker._tracks["vue_1"]._state.estimator.estimate
    assert estimate.mean.size == 10
    names = ["a", "b", "c", "d"]
    by_name = dict(zip(names, estimate.mean[6:], strict=True))
    assert by_name["c"] == pytest.approx(2.0, abs=0.4)
    assert abs(by_name["a"]) < 0.01
    assert error(output, straight(9.9)) < 0.5
    ignorant = world.tracker(gate_probability=1.0)
    for info in world.rsus.values():
        ignorant.add_rsu(replace(info, range_bias_sd_m=0.0))
    world.rng = np.random.default_rng(4)
    for k in range(100):
        (plain,) = feed(ignorant, world.measure(0.1 * k, straight(0.1 * k), Field.RANGE))
    assert error(plain, straight(9.9)) > 2 * error(output, straight(9.9))


def test_a_bias_state_starts_at_its_stationary_variance_and_stays_there(
    world: Any, feed: Any
) -> None:
    with_errors(world, range_bias_sd_m=0.7, bias_correlation_time_s=2.0)
    tracker = world.tracker(**KNOWN_CLOCK)
    feed(tracker, [pose(0.0, 40.0, 2.0, 0.01)])
    track = tracker._tracks["vue_1"]
    estimator = track._state.estimator
    heard = world.measure(0.0, standing(), Field.RANGE)[0]
    estimator.biases.row_errors(track._rsus["a"], heard, np.ones(1))
    estimator.bias = estimator.biases.arrays()
    for t_ns in (T0, T0 + 10**9, T0 + 50 * 10**9):
        estimate = estimator._prepared(t_ns)
        estimate.predict(t_ns, estimator.bias)
        assert estimate.mean.size == 7
        assert estimate.cov[6, 6] == pytest.approx(0.49)
        np.testing.assert_array_equal(estimate.cov[:6, 6], 0.0)
        assert estimate.mean[6] == 0.0


def test_common_network_bias_only_widens_the_covariance(world: Any, feed: Any) -> None:
    """It cannot be told from the clock: the same estimate with a larger sd."""
    results = []
    for common in (0.0, 2.0):
        with_errors(
            world, common_range_bias_sd_m=common, common_bias_correlation_time_s=1e6 * (common > 0)
        )
        tracker = world.tracker()
        feed(tracker, [pose(0.0, 0.0, 0.0)])
        for k in range(40):
            (output,) = feed(tracker, world.measure(0.1 * k, straight(0.1 * k, 100.0), Field.TOA))
        results.append(output)
    plain, wide = results
    np.testing.assert_allclose(wide.odometry.position, plain.odometry.position, atol=0.02)
    assert wide.clock.cov[0, 0] * speed_of_light**2 == pytest.approx(
        plain.clock.cov[0, 0] * speed_of_light**2 + 4.0, rel=0.02
    )
    assert len(tracker._tracks["vue_1"]._state.estimator.biases.sd) == 1


def test_coloured_noise_is_inflated_and_keeps_the_covariance_honest(world: Any, feed: Any) -> None:
    """Exponentially correlated range errors: the inflated filter's NEES is right, the naive one's
    far too large."""
    tau, dt, runs = 0.5, 0.1, 60
    means = {}
    for spectral in (0.0, 2 * tau):
        with_errors(world, noise_correlation_time_s=spectral)
        nees = []
        for seed in range(runs):
            rng = np.random.default_rng(seed)
            tracker = world.tracker(gate_probability=1.0, accel_density_mps2_sqrthz=1e-6)
            feed(tracker, [pose(-0.1, 40.0, 2.0, 4.0), velocity(-0.1, (0.0, 0.0), 1e-8)])
            e, keep = rng.normal(size=3), math.exp(-dt / tau)
            for k in range(60):
                items = world.measure(dt * k, standing(), Field.RANGE)
                items = [
                    replace(m, range_m=m.range_m + world.range_sd * e[i])
                    for i, m in enumerate(items)
                ]
                feed(tracker, items)
                e = keep * e + math.sqrt(1 - keep**2) * rng.normal(size=3)
            estimate = tracker._tracks["vue_1"]._state.estimator.estimate
            d = estimate.mean[POSITION] - standing()[:2]
            nees.append(d @ np.linalg.solve(estimate.cov[POSITION, POSITION], d))
        means[spectral] = float(np.mean(nees))
    low, high = chi2.ppf([0.0005, 0.9995], 2 * runs) / runs
    assert low < means[2 * tau] < high
    assert means[0.0] > 2 * high


def test_height_of_the_device_is_reported_and_used(world: Any, feed: Any) -> None:
    tracker = world.tracker(device_height_m=1.5)
    (output,) = feed(tracker, world.measure(0.0, standing()))
    assert output.odometry.position[2] == 1.5


def test_a_new_track_has_no_heading_yet(world: Any, feed: Any) -> None:
    tracker = world.tracker(**STILL)
    feed(tracker, [pose(0.0, 0.0, 0.0), velocity(0.0, (0.0, 3.0), 1e-4)])
    (output,) = feed(tracker, [pose(0.1, 0.0, 0.0)])
    np.testing.assert_array_equal(output.odometry.quaternion, [0.0, 0.0, 0.0, 1.0])


def test_heading_is_held_at_rest(world: Any, feed: Any) -> None:
    tracker = world.tracker(**STILL)
    feed(tracker, [pose(0.0, 0.0, 0.0), velocity(0.0, (0.0, 3.0), 1e-4)])
    (output,) = feed(tracker, [velocity(0.1, (0.0, 3.0), 1e-4)])
    assert 2 * math.atan2(*output.odometry.quaternion[2:]) == pytest.approx(math.pi / 2, abs=0.01)
    tracker._tracks["vue_1"]._state.estimator.estimate.mean[2:4] = 0.0
    (output,) = feed(tracker, [velocity(0.1 + 1e-9, (0.0, 0.0), 1e-4)])
    assert 2 * math.atan2(*output.odometry.quaternion[2:]) == pytest.approx(math.pi / 2, abs=0.01)
    assert output.odometry.pose_cov[5, 5] == pytest.approx(math.pi**2 / 3)
