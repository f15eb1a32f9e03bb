"""Stamps that cannot be right, time that stands still, jumps or goes back, and long gaps."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.estimation.state import X
from netpos.tracking import Tracker
from street_run import epochs, fed, ran, truth

T0 = 1_000_000_000
MS = 1_000_000
VARIANTS: dict[str, dict[str, Any]] = {
    "ekf": {"filter": "ekf", "process_noise": "werner"},
    "iekf": {},
    "ukf": {"filter": "ukf"},
    "srukf": {"filter": "srukf"},
    "interacting": {"motion_model": "interacting"},
    "inertial": {"motion_model": "inertial"},
}


def state(tracker: Tracker) -> list[Any]:
    """Estimate and counts, bit by bit."""
    s = tracker._tracks["vue_1"]._state
    estimate = [
        s.estimator.estimate.stamp_ns,
        s.estimator.estimate.mean.tobytes(),
        s.estimator.estimate.cov.tobytes(),
    ]
    return [*estimate, s.accepted, dict(s.rejected), s.last_accepted_ns]


def test_stamp_zero_is_refused(world: Any) -> None:
    tracker = ran(world, epochs(world, 3))
    for stamp in (0, -1):
        item = replace(world.measure(0.3, truth(0.3))[0], stamp_ns=stamp)
        assert tracker.add(item) == "zero_stamp"
    assert tracker.process() == []


def test_one_stamp_far_in_the_future_counts_for_nothing(world: Any) -> None:
    tracker = ran(world, epochs(world, 10), max_future_s=60.0)
    before = state(tracker)
    (far,) = world.measure(0.9 + 60.0 + 1e-9, truth(1.0), names=["a"])
    assert tracker.add(far) is None  # it waits for a second voice
    assert tracker.process() == []
    assert state(tracker) == before
    (output,) = fed(tracker, world.measure(1.0, truth(1.0)))
    assert output.status.used == 3
    assert output.status.rejected == {"clock_ahead": 1}
    (again,) = world.measure(70.0, truth(1.0), names=["a"])
    assert tracker.add(again) is None
    assert [tracker.add(m) for m in world.measure(1.1, truth(1.1), names=["b", "c"])] == [None] * 2
    assert tracker.add(again) == "clock_ahead"  # two contradict it


def test_an_only_rsu_confirms_its_own_future(world: Any) -> None:
    batches = [world.measure(0.1 * k, truth(0.1 * k), names=["a"]) for k in range(10)]
    tracker = ran(world, batches, max_future_s=60.0)
    (far,), (other,), (near,) = (
        world.measure(t, truth(1.0), names=["a"]) for t in (70.0, 200.0, 200.1)
    )
    assert tracker.add(far) == "future_stamp"
    assert tracker.add(other) == "future_stamp"  # as far away again: no confirmation
    assert tracker.add(near) is None
    tracker = ran(world, batches, max_future_s=60.0)
    (limit,) = world.measure(0.9 + 60.0, truth(1.0), names=["a"])
    assert tracker.add(limit) is None  # at the limit no confirmation is needed


def test_a_second_voice_confirms_the_future(world: Any) -> None:
    tracker = ran(world, epochs(world, 10), max_future_s=60.0)
    far = world.measure(100.0, truth(1.0))
    assert tracker.add(far[0]) is None
    assert tracker.process() == []
    assert tracker.add(far[1]) is None
    assert tracker.add(far[2]) is None
    (output,) = tracker.process()
    assert output.status.stamp_ns == far[0].stamp_ns
    assert output.status.rejected == {}


@pytest.mark.parametrize("history_s", [0.0, 1.0])
def test_time_set_back_starts_anew(world: Any, history_s: float) -> None:
    """Ten stamps in a row from before the history, then the track begins again in the past."""
    later = [world.measure(100.0 + 0.1 * k, truth(0.1 * k)) for k in range(9)]
    tracker = ran(world, later, history_s=history_s)
    backward = [m for k in range(6) for m in world.measure(0.1 * k, truth(0.1 * k))]
    reasons = [tracker.add(m) for m in backward]
    assert reasons == ["late"] * 10 + [None] * 8
    outputs = tracker.process() + tracker.flush()
    assert [o.status.stamp_ns for o in outputs] == [T0 + k * 100 * MS for k in (3, 4, 5)]
    assert outputs[-1].odometry is not None
    assert outputs[-1].status.rejected["late"] == 10
    assert outputs[-1].status.accepted == 27 + 6  # two RSUs are no first fix yet
    error = outputs[-1].odometry.position[:2] - truth(0.5)[:2]
    assert np.linalg.norm(error) < 1.0


def test_nine_stamps_from_the_past_are_no_new_time(world: Any) -> None:
    tracker = ran(world, [world.measure(100.0 + 0.1 * k, truth(0.1 * k)) for k in range(9)])
    backward = [m for k in range(3) for m in world.measure(0.1 * k, truth(0.1 * k))]
    for _ in range(3):  # what is in time in between ends the row
        assert [tracker.add(m) for m in backward] == ["late"] * 9
        k = tracker._tracks["vue_1"]._state.accepted // 3
        (output,) = fed(tracker, world.measure(100.0 + 0.1 * k, truth(0.1 * k)))
        assert output.status.used == 3


def test_pause_and_resume_are_harmless(world: Any) -> None:
    """A paused source repeats its last stamp: nothing new, nothing lost, nothing counted twice."""
    batches = epochs(world, 20)
    plain = ran(world, batches)
    paused = world.tracker()
    for batch in batches:
        fed(paused, batch)
        for _ in range(5):
            assert [paused.add(m) for m in batch] == ["duplicate"] * 3
            assert paused.process() + paused.flush() == []
    assert state(paused) == state(plain)


@pytest.mark.parametrize("name", VARIANTS)
def test_a_gap_inflates_the_covariance_and_no_more(world: Any, name: str) -> None:
    """Up to max_gap_s the track is predicted, beyond it starts anew; all of it finite."""
    config = VARIANTS[name] | {"max_gap_s": 30.0, "gate_probability": 1.0}
    for gap_s, updated in ((29.9, True), (30.1, False), (5000.0, False)):
        tracker = ran(world, epochs(world, 20), **config, max_future_s=1e5)
        tracker.flush()
        track = tracker._tracks["vue_1"]
        before = track._state.estimator.estimate.cov
        ahead = track._state.estimator.estimate.copy()
        ahead.predict(T0 + round((1.9 + gap_s) * 1e9), track._state.estimator.bias)
        np.linalg.cholesky(ahead.cov)
        assert np.isfinite(ahead.mean).all()
        assert ahead.cov[X.PX, X.PX] > before[0, 0]
        # white acceleration, a lost velocity, no more than a turning, braking car could do
        augmented = math.sqrt(ahead.cov[X.PX, X.PX])
        assert 0.1 < augmented < 40.0 * gap_s**1.5 + 1.0
        (output,) = [
            *fed(tracker, world.measure(1.9 + gap_s, truth(1.9))),
            *tracker.flush(),
        ]
        assert output.status.used == 3
        assert (output.status.nis_dof > 0) is updated
        assert np.isfinite(output.odometry.pose_cov).all()
        np.linalg.cholesky(output.odometry.pose_cov[:2, :2])
