"""The estimate over the sectors of a phase difference, through the tracker, with what goes wrong
on a real anchor."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from anchor_walk import (
    CONFIG,
    DT_NS,
    INFO,
    NORTH,
    PHASE_SD,
    RANGE_SD,
    T0,
    TURNS,
    WAVELENGTH,
    Walk,
    errors,
    tracked,
    true_values,
    wrap,
)
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.state import POSITION
from netpos.messages.values import (
    Field,
    InitialPose,
    RsuInfo,
    RsuMeasurement,
    TrackState,
)
from netpos.tracking import Tracker, TrackerConfig, TrackOutput
from netpos.tracking.first_fix.phase_start import PhaseStart


def test_ambiguous_until_the_evidence_decides() -> None:
    walk = Walk(np.array([-1.0, 4.0]), 0.4, 3.0, seed=5)
    outputs = tracked(walk)
    states = [o.status.state for o in outputs]
    first = states.index(TrackState.TRACKING)
    assert 2 <= first <= 20
    assert set(states[:first]) == {TrackState.AMBIGUOUS}
    modes = outputs[0].status.modes
    assert len(modes) > 1
    assert [m.weight for m in modes] == sorted((m.weight for m in modes), reverse=True)
    assert min(math.hypot(*(walk.position[0] - (m.x_m, m.y_m))) for m in modes) < 0.3
    assert outputs[-1].status.modes == ()
    assert set(states[first:]) == {TrackState.TRACKING}
    error = errors(walk, outputs)
    assert error[first:].max() < 0.15
    before, after = outputs[first - 1].status, outputs[first].status
    # a rival sector is a metre away: the level says so for as long as it is not ruled out
    assert before.protection_level_m > 0.8
    assert after.position_sd_m < 0.1 < before.position_sd_m * 2
    assert outputs[2].status.position_sd_m > 0.3
    assert outputs[-1].status.protection_level_m < 0.5
    assert all(e <= o.status.protection_level_m for e, o in zip(error, outputs, strict=True))


def test_standing_still_leaves_the_sector_open() -> None:
    walk = Walk(np.array([1.0, 3.0]), 0.0, 4.0, seed=6)
    walk.position[:] = walk.start
    ranges, phases = true_values(walk.position)
    rng = np.random.default_rng(6)
    walk.ranges = ranges + RANGE_SD * rng.standard_normal(40)
    walk.phases = wrap(phases + PHASE_SD * rng.standard_normal(40))
    walk.velocities -= walk.velocity
    outputs = tracked(walk)
    assert {o.status.state for o in outputs} == {TrackState.AMBIGUOUS}


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_fix_is_found_and_repaired(seed: int) -> None:
    """A pose from outside in the neighbouring sector, sure of itself."""
    walk = Walk(np.array([0.5, 4.0]), 0.2 + seed, 5.0, seed)
    sine = math.sin(math.atan2(*walk.start)) + 1 / TURNS
    wrong = np.hypot(*walk.start) * np.array([sine, math.sqrt(1 - sine**2)])
    pose = InitialPose(
        stamp_ns=T0, vue_id="v", position=np.array([*wrong, 0.0]), cov=np.eye(3) * 0.1**2
    )
    outputs = tracked(walk, [pose])
    error = errors(walk, outputs)
    assert error[2] > 0.5
    assert outputs[2].status.state == TrackState.TRACKING
    assert TrackState.AMBIGUOUS in {o.status.state for o in outputs}
    assert outputs[-1].status.state == TrackState.TRACKING
    assert error[-10:].max() < 0.15


def test_a_right_fix_stays_in_its_sector() -> None:
    for seed in range(5):
        walk = Walk(np.array([-2.0, 3.0]), 0.3, 4.0, seed)
        outputs = tracked(walk)
        decided = np.array([o.status.state is TrackState.TRACKING for o in outputs])
        assert decided.mean() > 0.7
        assert decided[-10:].all()
        assert errors(walk, outputs)[decided].max() < 0.15


def test_a_rough_pose_from_outside_chooses_the_sector_at_once() -> None:
    """Within half a metre: the posterior of the pose, not the nearest number of turns to it."""
    walk = Walk(np.array([0.5, 4.0]), 0.2, 2.0, 3)
    pose = InitialPose(
        stamp_ns=T0, vue_id="v", position=np.array([0.4, 4.2, 0.0]), cov=np.eye(3) * 0.2**2
    )
    outputs = tracked(walk, [pose])
    assert outputs[1].status.state == TrackState.TRACKING
    assert errors(walk, outputs).max() < 0.15


@pytest.mark.parametrize("seed", range(4))
def test_a_slip_while_hidden_is_survived(seed: int) -> None:
    """Hidden for 5 s with a velocity off by 0.15 m/s: the prediction ends 0.75 m aside, in the
    neighbouring sector; what is then nearest to it is the wrong place."""
    walk = Walk(np.array([-3.0, 3.0]), 0.15, 9.0, seed, hidden=(2.0, 6.0))
    gone = slice(20, 60)
    walk.velocities[gone] += 0.15 * np.array([1.0, 0.0])
    outputs = tracked(walk, accel_density_mps2_sqrthz=0.5)
    error = errors(walk, outputs)
    assert error[59] > 0.4
    assert error[-10:].max() < 0.15
    assert outputs[-1].status.state == TrackState.TRACKING


@pytest.mark.parametrize("seed", range(3))
def test_a_burst_of_wrong_phases_is_survived(seed: int) -> None:
    walk = Walk(np.array([-2.0, 3.0]), 0.3, 6.0, seed, spoilt=(2.5, 3.3))
    error = errors(walk, tracked(walk))
    assert error[20:25].max() < 0.15
    assert error[-10:].max() < 0.15


def test_half_a_wavelength_needs_no_decision() -> None:
    """K = 1: one sector, decided by the first measurement."""
    info = RsuInfo(
        rsu_id="anchor",
        position=np.zeros(3),
        quaternion=NORTH,
        baseline_m=WAVELENGTH / 2,
        wavelength_m=WAVELENGTH,
    )
    xy = np.array([[1.0, 4.0]])
    sine = math.sin(math.atan2(1.0, 4.0))
    walk = Walk(xy[0], 0.0, 0.1)
    measured = walk.measured(0)
    measured.phase_difference_rad = math.pi * sine
    rows = rsu_rows(measured, info, rsu_axes(info), 0)
    estimate = PhaseStart(TrackerConfig(**CONFIG)).add(T0, rows, np.zeros(2))
    assert estimate is not None
    assert estimate.modes == ()
    assert np.hypot(*(estimate.mean[POSITION] - xy[0])) < 0.1


STEADY = {"steady_accel_density_mps2_sqrthz": 0.05}


@pytest.mark.parametrize("settings", [{}, STEADY])
def test_late_measurements_give_the_estimates_of_arrival_in_order(
    settings: dict[str, float],
) -> None:
    walk = Walk(np.array([-1.0, 4.0]), 0.4, 2.0, seed=5)
    in_order = tracked(walk, **settings)
    tracker = Tracker(TrackerConfig(**(CONFIG | settings)))
    tracker.add_rsu(INFO)
    held: list[Any] = []
    last: TrackOutput | None = None
    for k in range(20):
        items = walk.items(k)
        if k in (6, 11):
            held.append(items.pop())
        for item in items:
            assert tracker.add(item) is None
        if k in (9, 15):
            assert tracker.add(held.pop(0)) is None
        for output in tracker.process():
            last = output
    for output in tracker.flush():
        last = output
    assert last is not None
    assert last.odometry is not None
    assert in_order[-1].odometry is not None
    np.testing.assert_array_equal(last.odometry.position, in_order[-1].odometry.position)
    np.testing.assert_array_equal(last.odometry.pose_cov, in_order[-1].odometry.pose_cov)


def test_who_keeps_the_speed_is_known_better() -> None:
    """And who stops is believed at once: the velocity reported tells."""
    walk = Walk(np.array([-1.0, 3.0]), 0.4, 4.0, seed=8)
    walk.position[20:] = walk.position[20]
    walk.velocities[20:] -= walk.velocity
    ranges, phases = true_values(walk.position)
    noise = 1e-6 * np.random.default_rng(8).standard_normal(len(ranges))  # or it would be stuck
    walk.ranges, walk.phases = ranges + noise, wrap(phases)
    spread, error = [], []
    for settings in ({}, STEADY):
        outputs = tracked(walk, **settings)
        last = outputs[19].odometry
        assert last is not None
        spread.append(np.trace(last.pose_cov[:2, :2]))
        error.append(errors(walk, outputs)[20:])
    assert spread[1] < 0.6 * spread[0]
    assert error[1].max() < 0.06


def test_a_second_rsu_with_biases_settles_the_first_epoch() -> None:
    """Its range tells the sectors apart in two epochs; its bias becomes a state later."""
    tracker = Tracker(TrackerConfig(**CONFIG))
    tracker.add_rsu(INFO)
    biased = {"range_bias_sd_m": 0.05, "bias_correlation_time_s": 60.0}
    tracker.add_rsu(RsuInfo(rsu_id="side", position=np.array([9.0, 4.0, 0.0]), **biased))  # type: ignore[arg-type]
    walk = Walk(np.array([0.5, 4.0]), 0.2, 2.0, 3)
    outputs: list[TrackOutput] = []
    for k in range(20):
        stamp = T0 + k * DT_NS
        measured = walk.measured(k)
        measured.expected = 2
        side = RsuMeasurement(
            stamp_ns=stamp,
            rsu_id="side",
            vue_id="v",
            expected=2,
            fields=Field.RANGE,
            range_m=float(np.hypot(*(walk.position[k] - [9.0, 4.0]))),
            range_var=0.05**2,
        )
        for item in (side, measured):
            assert tracker.add(item) is None
        outputs += tracker.process()
    assert outputs[1].status.state == TrackState.TRACKING
    error = errors(walk, [*outputs, *tracker.flush()])
    assert error.max() < 0.25
    assert error[-5:].max() < 0.1
