"""One device: convergence, consistency, gating and recovery, slow and coloured errors."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.filters.motion import process_noise, transition
from netpos.messages.values import (
    Array,
    Field,
    GroundSpeed,
    InitialPose,
    RsuInfo,
    TrackState,
    Velocity,
)
from netpos.tracking import TrackOutput
from netpos.tracking.track import gate_thresholds
from scipy.constants import speed_of_light
from scipy.stats import chi2

T0 = 1_000_000_000
KNOWN_CLOCK = {"clock_offset_sd_s": 1e-12, "clock_drift_mean": 0.0, "clock_drift_sd": 1e-12}
ALL = Field.AZIMUTH | Field.TOA
STILL = {"accel_density_mps2_sqrthz": 1e-6}


def straight(t_s: float, clock_m: float = 0.0, drift_mps: float = 0.0) -> Array:
    """East along the street at 8 m/s."""
    return np.array([8.0 * t_s, 0.0, 8.0, 0.0, clock_m + drift_mps * t_s, drift_mps])


def standing(x: float = 40.0, y: float = 2.0) -> Array:
    return np.array([x, y, 0.0, 0.0, 0.0, 0.0])


def pose(t_s: float, x: float, y: float, var: float = 1.0) -> InitialPose:
    return InitialPose(
        stamp_ns=T0 + round(t_s * 1e9),
        vue_id="vue_1",
        position=np.array([x, y, 0.0]),
        cov=var * np.eye(3),
    )


def velocity(t_s: float, v: tuple[float, float], var: float = 0.01, **change: Any) -> Velocity:
    values = {"stamp_ns": T0 + round(t_s * 1e9), "vue_id": "vue_1"}
    return Velocity(velocity=np.array(v), cov=var * np.eye(2), **(values | change))


def error(output: TrackOutput, truth: Array) -> float:
    assert output.odometry is not None
    return float(np.linalg.norm(output.odometry.position[:2] - truth[:2]))


def map_velocity(output: TrackOutput) -> Array:
    assert output.odometry is not None
    z, w = output.odometry.quaternion[2:]
    yaw = 2.0 * math.atan2(z, w)
    v = output.odometry.linear_velocity
    return np.array(
        [math.cos(yaw) * v[0] - math.sin(yaw) * v[1], math.sin(yaw) * v[0] + math.cos(yaw) * v[1]]
    )


# convergence


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
    assert abs(clock.offset_s * speed_of_light - truth[4]) < 1.0
    assert abs(clock.drift * speed_of_light - 7500.0) < 30.0
    assert (
        abs(clock.offset_s * speed_of_light - truth[4])
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


def model_track(seed: int, kind: str) -> list[Array]:
    """Truth drawn from the tracker's own model: 25 states, 0.2 s apart."""
    rng = np.random.default_rng(seed)
    none = np.zeros(0)
    index = {"continuous": 0, "werner": 1, "white_acceleration": 2}[kind]
    args = (0.8, 0.4, 0.05, 0.5, 0.3)
    Q = process_noise(index, 0.2, *args, none, none)
    F = transition(6, 0.2, none)
    state = np.array([30.0, 0.0, 0.0, 0.0, 0.0, 0.0]) + rng.normal(size=6) * [2, 2, 3, 3, 30, 9]
    states = []
    w, V = np.linalg.eigh(Q)
    root = V * np.sqrt(np.maximum(w, 0.0))
    for _ in range(25):
        state = F @ state + root @ rng.normal(size=6)
        states.append(state)
    return states


@pytest.mark.parametrize("filter_name", ["ekf", "iekf"])
@pytest.mark.parametrize("kind", ["continuous", "werner", "white_acceleration"])
def test_covariance_is_consistent_when_truth_follows_the_model(
    world: Any, feed: Any, kind: str, filter_name: str
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
        states = model_track(seed, kind)
        tracker = world.tracker(**config)
        world.rng = np.random.default_rng(10_000 + seed)
        feed(tracker, [pose(0.0, 30.0, 0.0, 4.0)])
        for k, state in enumerate(states):
            feed(tracker, world.measure(0.2 * (k + 1), state))
        estimate = tracker._tracks["vue_1"]._estimate
        e = estimate.mean - states[-1]
        nees.append(e @ np.linalg.solve(estimate.cov, e))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * runs) / runs
    assert low < np.mean(nees) < high


# first fix and initial pose


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


def test_first_fix_knows_of_the_biases(world: Any, feed: Any) -> None:
    """Own bias 0.4 m and common bias 1.2 m on 0.3 m of noise: the sd grows by 1.3 / 0.3."""
    (plain,) = feed(world.tracker(), world.measure(0.0, standing(), Field.RANGE))
    with_errors(
        world,
        range_bias_sd_m=0.4,
        bias_correlation_time_s=9.0,
        common_range_bias_sd_m=1.2,
        common_bias_correlation_time_s=9.0,
    )
    (biased,) = feed(world.tracker(), world.measure(0.0, standing(), Field.RANGE))
    ratio = biased.status.position_sd_m / plain.status.position_sd_m
    assert ratio == pytest.approx(1.3 / 0.3, rel=0.01)


def test_initial_pose_starts_the_track_as_the_paper_does(world: Any, feed: Any) -> None:
    """fokin2020:eq.32, 33: position given, velocity 0, clock 0, drift 25 ppm."""
    tracker = world.tracker()
    p = replace(pose(0.0, 3.0, 4.0), cov=np.array([[4.0, 1.0, 0], [1.0, 9.0, 0], [0, 0, 1.0]]))
    (output,) = feed(tracker, [p])
    assert output.status.stamp_ns == T0
    assert (output.status.used, output.status.accepted) == (0, 0)
    estimate = tracker._tracks["vue_1"]._estimate
    c = speed_of_light
    np.testing.assert_allclose(estimate.mean, [3.0, 4.0, 0, 0, 0, 25e-6 * c])
    expected = np.diag([4.0, 9.0, 25.0, 25.0, (1e-4 * c) ** 2, (30e-6 * c) ** 2])
    expected[0, 1] = expected[1, 0] = 1.0
    np.testing.assert_allclose(estimate.cov, expected, rtol=1e-12)


def test_initial_pose_replaces_a_running_track(world: Any, feed: Any) -> None:
    tracker = world.tracker()
    for k in range(5):
        feed(tracker, world.measure(0.1 * k, straight(0.1 * k)))
    (output,) = feed(tracker, [pose(0.5, 500.0, 500.0)])
    np.testing.assert_allclose(output.odometry.position, [500.0, 500.0, 0.0])
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


# gate


def test_gate_thresholds_are_chi_square_quantiles() -> None:
    t = gate_thresholds(0.95)
    np.testing.assert_allclose(t[:4], [0.0, 3.841459, 5.991465, 7.814728], atol=1e-6)
    assert len(t) == 13
    assert np.isinf(gate_thresholds(1.0)[1:]).all()


def settled(world: Any, feed: Any, fields: Field = ALL, **config: Any) -> Any:
    tracker = world.tracker(**(STILL | config))
    for k in range(20):
        feed(tracker, world.measure(0.1 * k, standing(), fields))
    return tracker


def test_gate_counts_and_leaves_the_others(world: Any, feed: Any) -> None:
    tracker = settled(world, feed)
    items = world.measure(2.0, standing())
    items[1] = replace(items[1], azimuth_rad=items[1].azimuth_rad + 1.0)
    (output,) = feed(tracker, items)
    assert output.status.rejected == {"gate": 1}
    assert output.status.sources == ("a", "c")
    assert (output.status.used, output.status.nis_dof) == (2, 4)
    assert output.status.accepted == 62
    assert error(output, standing()) < 0.05


def test_gate_probability_one_accepts_everything(world: Any, feed: Any) -> None:
    tracker = settled(world, feed, gate_probability=1.0)
    items = [replace(m, azimuth_rad=m.azimuth_rad + 1.0) for m in world.measure(2.0, standing())]
    (output,) = feed(tracker, items)
    assert output.status.rejected == {}
    assert output.status.used == 3


def test_lost_track_finds_itself_again(world: Any, feed: Any) -> None:
    """The device is somewhere else: 10 epochs are rejected, then a new first fix is taken."""
    tracker = settled(world, feed, max_rejected_epochs=10, inflate_after_epochs=10000)
    elsewhere, outputs = standing(80.0, 30.0), []
    for k in range(12):
        outputs += feed(tracker, world.measure(2.0 + 0.1 * k, elsewhere))
    assert [o.status.used for o in outputs] == [0] * 10 + [3, 3]
    assert [o.status.rejected["gate"] for o in outputs[:10]] == list(range(3, 31, 3))
    assert [o.odometry is None for o in outputs] == [False] * 9 + [True, False, False]
    assert [o.status.rejected.get("track_lost", 0) for o in outputs] == [0] * 9 + [1] * 3
    assert error(outputs[-1], elsewhere) < 0.5
    # rejected epochs leave the estimate where it was, and it only widens
    assert error(outputs[8], standing()) < 0.05
    sds = [o.status.position_sd_m for o in outputs[:9]]
    assert sds == sorted(sds)
    assert outputs[0].status.nis_dof == 0


def test_an_initial_pose_counts_rejected_epochs_from_none(world: Any, feed: Any) -> None:
    config = {"max_rejected_epochs": 3, "inflate_after_epochs": 10000}
    tracker = settled(world, feed, **config)
    elsewhere = standing(80.0, 30.0)
    for k in range(2):
        feed(tracker, world.measure(2.0 + 0.1 * k, elsewhere))
    feed(tracker, [pose(2.2, 40.0, 2.0, 0.01)])
    states = []
    for k in range(3):
        (output,) = feed(tracker, world.measure(2.3 + 0.1 * k, elsewhere))
        states.append(output.status.state)
    # the pose is news of the device: no coasting for a second after it
    assert states == [TrackState.TRACKING, TrackState.TRACKING, TrackState.WAITING]


def test_rejected_epochs_do_not_leave_the_velocity_opened(world: Any, feed: Any) -> None:
    """Opening is a trial: where nothing passes even then, the covariance is the prediction's."""
    sds = []
    for after in (1, 10000):
        tracker = settled(world, feed, inflate_after_epochs=after, max_rejected_epochs=100)
        for k in range(5):
            far = standing(40.0, 900.0)
            (output,) = feed(tracker, world.measure(2.0 + 0.1 * k, far, Field.RANGE))
        assert output.status.used == 0
        sds.append(output.status.position_sd_m)
    assert sds[0] == sds[1]


def test_an_accepted_epoch_ends_the_row_of_rejected_ones(world: Any, feed: Any) -> None:
    tracker = settled(world, feed, max_rejected_epochs=3, inflate_after_epochs=10000)
    for k in range(12):
        place = standing() if k % 3 == 2 else standing(80.0, 30.0)
        (output,) = feed(tracker, world.measure(2.0 + 0.1 * k, place))
    assert "track_lost" not in output.status.rejected
    assert output.status.rejected["gate"] == 24


def test_velocity_is_opened_after_rejected_epochs(world: Any, feed: Any) -> None:
    """A parked car drives off at 4 m/s, which the process noise forbids."""
    lost = {}
    for after in (2, 10000):
        tracker = settled(
            world, feed, Field.RANGE, inflate_after_epochs=after, max_rejected_epochs=10000
        )
        outputs = []
        for k in range(20):
            moved = standing(40.0 + 0.4 * k, 2.0)
            outputs += feed(tracker, world.measure(2.0 + 0.1 * k, moved, Field.RANGE))
        lost[after] = error(outputs[-1], moved)
        first_rejected = next(i for i, o in enumerate(outputs) if o.status.used == 0)
        if after == 2:
            used = [o.status.used for o in outputs[first_rejected:]]
            assert used[:2] == [0, 0]
            assert used[2] == 3
    assert lost[2] < 1.0
    assert lost[10000] > 3.0


def test_opening_the_velocity_is_a_step_since_the_last_accepted(world: Any, feed: Any) -> None:
    """After s seconds a velocity step of sd v adds v^2 [[s^2, s], [s, 1]] per axis."""
    tracker = settled(world, feed)
    track = tracker._tracks["vue_1"]
    predicted = track._predict(T0 + 2_900_000_000)  # last accepted at 1.9 s
    opened = track._opened(predicted, 3.0)
    added = opened.cov - predicted.cov
    expected = np.zeros((6, 6))
    for p in (0, 1):
        expected[np.ix_([p, p + 2], [p, p + 2])] = [[9.0, 9.0], [9.0, 9.0]]
    np.testing.assert_allclose(added, expected, atol=1e-7)
    later = track._opened(track._predict(T0 + 3_900_000_000), 3.0)
    added = later.cov - track._predict(T0 + 3_900_000_000).cov
    np.testing.assert_allclose(
        added[np.ix_([1, 3], [1, 3])], [[36.0, 18.0], [18.0, 9.0]], atol=1e-7
    )
    np.testing.assert_array_equal(opened.mean, predicted.mean)


def test_manoeuvre_is_accepted_at_once_where_allowed(world: Any, feed: Any) -> None:
    for sd in (0.0, 10.0):
        tracker = settled(world, feed, Field.RANGE, manoeuvre_speed_sd_mps=sd)
        (output,) = feed(tracker, world.measure(2.4, standing(44.0, 2.0), Field.RANGE))
        assert (output.status.used == 3) is (sd > 0.0)
        assert ("gate" in output.status.rejected) is (sd == 0.0)
    # a small allowance is one too: 1.5 m in half a second
    for sd in (0.0, 0.9):
        tracker = settled(world, feed, Field.RANGE, manoeuvre_speed_sd_mps=sd)
        (output,) = feed(tracker, world.measure(2.4, standing(41.5, 2.0), Field.RANGE))
        assert (output.status.used == 3) is (sd > 0.0)
    # an outlier no manoeuvre explains is rejected all the same, and then nothing is opened
    sds = []
    for sd in (0.0, 1.0):
        tracker = settled(world, feed, manoeuvre_speed_sd_mps=sd)
        items = world.measure(2.0, standing())
        items[1] = replace(items[1], azimuth_rad=items[1].azimuth_rad + 2.0)
        (output,) = feed(tracker, items)
        assert output.status.used == 2
        sds.append(output.status.position_sd_m)
    assert sds[0] == sds[1]


# time


def test_gap_starts_anew(world: Any, feed: Any) -> None:
    for gap, accepted_dof in ((29.9, 6), (30.1, 0)):
        tracker = settled(world, feed, max_gap_s=30.0, gate_probability=1.0)
        (output,) = feed(tracker, world.measure(1.9 + gap, standing()))
        assert output.status.used == 3
        assert output.status.nis_dof == accepted_dof  # 0: a first fix, not an update
        assert error(output, standing()) < 1.0


def test_a_gap_forgets_the_biases_too(world: Any, feed: Any) -> None:
    """The states of RSUs heard before the gap must not be counted for the new track."""
    with_errors(world, range_bias_sd_m=0.5, bias_correlation_time_s=100.0)
    tracker = world.tracker(max_gap_s=1.0)
    feed(tracker, world.measure(0.0, standing(), Field.RANGE))
    feed(tracker, world.measure(9.0, standing(), Field.RANGE | Field.AZIMUTH))
    track = tracker._tracks["vue_1"]
    assert track._biases.sd == [0.5] * 3
    assert track._estimate.mean.size == 9
    (output,) = feed(tracker, world.measure(9.1, standing(), Field.RANGE))
    assert output.status.used == 3


def test_coasting_after_silence(world: Any, feed: Any) -> None:
    tracker = settled(world, feed, coast_after_s=1.0, inflate_after_epochs=10000)
    elsewhere = standing(80.0, 30.0)
    (output,) = feed(tracker, world.measure(2.9, elsewhere))
    assert output.status.state is TrackState.TRACKING
    (output,) = feed(tracker, world.measure(2.9 + 1e-9, elsewhere))
    assert output.status.state is TrackState.COASTING
    assert output.odometry is not None


def test_prediction_between_measurements_is_the_model(world: Any, feed: Any) -> None:
    tracker = settled(world, feed, accel_density_mps2_sqrthz=0.7)
    track = tracker._tracks["vue_1"]
    now = track._estimate
    ahead = track._predict(T0 + 2_400_000_000)
    none, c = np.zeros(0), speed_of_light
    F = transition(6, 0.5, none)
    Q = process_noise(0, 0.5, 0.7, 1e9, 1e-10 * c, 2.5e-7 * c, 1e9, none, none)
    np.testing.assert_allclose(ahead.mean, F @ now.mean, rtol=1e-12)
    np.testing.assert_allclose(ahead.cov, F @ now.cov @ F.T + Q, rtol=1e-9, atol=1e-12)
    assert ahead.stamp_ns == T0 + 2_400_000_000
    same = track._predict(now.stamp_ns)
    np.testing.assert_array_equal(same.cov, now.cov)


@pytest.mark.parametrize(
    ("kind", "index", "args"),
    [
        ("werner", 1, (1e9, 0.3, 1e9, 1e9, 0.02)),
        ("white_acceleration", 2, (0.6, 1e9, 1e9, 1e9, 0.02)),
    ],
)
def test_each_process_noise_takes_its_own_parameters(
    world: Any, feed: Any, kind: str, index: int, args: tuple[float, ...]
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
    none = np.zeros(0)
    F = transition(6, 0.5, none)
    Q = process_noise(index, 0.5, *args, none, none)
    ahead = track._predict(T0 + 500_000_000)
    np.testing.assert_allclose(ahead.cov - F @ track._estimate.cov @ F.T, Q, rtol=1e-5, atol=1e-5)


# velocities


def test_step_velocity_is_fused_as_the_equations_say(world: Any, feed: Any) -> None:
    tracker = world.tracker(**STILL)
    feed(tracker, [pose(0.0, 0.0, 0.0)])
    cov = np.array([[0.09, 0.03], [0.03, 0.04]])
    item = replace(velocity(0.0, (1.0, -2.0)), cov=cov, stamp_ns=T0)
    (output,) = feed(tracker, [item])
    P = np.eye(2) * 25.0
    K = P @ np.linalg.inv(P + cov)
    np.testing.assert_allclose(map_velocity(output), K @ [1.0, -2.0], rtol=1e-9)
    estimate = tracker._tracks["vue_1"]._estimate
    np.testing.assert_allclose(estimate.cov[2:4, 2:4], P - K @ P, rtol=1e-8, atol=1e-10)
    assert output.status.sources == ("step_velocity",)
    assert output.status.nis_dof == 2


def test_ground_speed_is_fused_along_the_motion(world: Any, feed: Any) -> None:
    tracker = world.tracker(filter="ekf", **STILL)
    feed(tracker, [pose(0.0, 0.0, 0.0), velocity(0.0, (3.0, 4.0), 0.25)])
    before = tracker._tracks["vue_1"]._estimate
    v = before.mean[2:4]
    u = v / np.linalg.norm(v)
    s = GroundSpeed(stamp_ns=T0, vue_id="vue_1", speed_mps=5.5, speed_var=0.04)
    (output,) = feed(tracker, [s])
    P = before.cov[2:4, 2:4]
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


# slow and coloured errors


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
    estimate = tracker._tracks["vue_1"]._estimate
    assert estimate.mean.size == 10
    names = ["a", "b", "c", "d"]
    by_name = dict(zip(names, estimate.mean[6:], strict=True))
    assert by_name["c"] == pytest.approx(2.0, abs=0.4)
    assert abs(by_name["a"]) < 0.01
    assert error(output, straight(9.9)) < 0.5
    ignorant = world.tracker()
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
    track._biases.coupling(track._rsus["a"], world.measure(0.0, standing(), Field.RANGE)[0])
    for t_ns in (T0, T0 + 10**9, T0 + 50 * 10**9):
        estimate = track._predict(t_ns)
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
    assert len(tracker._tracks["vue_1"]._biases.sd) == 1


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
            estimate = tracker._tracks["vue_1"]._estimate
            d = estimate.mean[:2] - standing()[:2]
            nees.append(d @ np.linalg.solve(estimate.cov[:2, :2], d))
        means[spectral] = float(np.mean(nees))
    low, high = chi2.ppf([0.0005, 0.9995], 2 * runs) / runs
    assert low < means[2 * tau] < high
    assert means[0.0] > 2 * high


# odometry


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
    tracker._tracks["vue_1"]._estimate.mean[2:4] = 0.0
    (output,) = feed(tracker, [velocity(0.1 + 1e-9, (0.0, 0.0), 1e-4)])
    assert 2 * math.atan2(*output.odometry.quaternion[2:]) == pytest.approx(math.pi / 2, abs=0.01)
    assert output.odometry.pose_cov[5, 5] == pytest.approx(math.pi**2 / 3)
