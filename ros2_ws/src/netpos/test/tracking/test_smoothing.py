"""Smoothing of whole tracks: agreement with the filter where it must, gain where it can."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array, Odometry, RsuMeasurement
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.smoothing.planar import Posterior, PosteriorRecorder, Smoother
from scipy.stats import chi2

STEP_S = 0.1
EPOCHS = 150


def drive(world: Any, seed: int) -> tuple[dict[int, Array], list[list[RsuMeasurement]]]:
    """A device whose acceleration and clock are what the continuous model says."""
    world.rng = rng = np.random.default_rng(seed)
    state = np.array([5.0, 0.0, 6.0, 0.5, 30.0, 1.0])
    truth, epochs = {}, []
    for k in range(1, EPOCHS + 1):
        noise = rng.normal(size=6) * math.sqrt(STEP_S) * np.array([0, 0, 0.5, 0.5, 0.03, 0.3])
        state = (
            state + STEP_S * np.array([state[X.VX], state[X.VY], 0, 0, state[X.DRIFT], 0]) + noise
        )
        measured = world.measure(k * STEP_S, state)
        truth[measured[0].stamp_ns] = state.copy()
        epochs.append(measured)
    return truth, epochs


def config(**change: Any) -> dict[str, Any]:
    return {
        "accel_density_mps2_sqrthz": 0.5,
        "clock_walk_density": 1e-9,
        "gate_probability": 1.0,
        **change,
    }


def run(world: Any, epochs: list[list[RsuMeasurement]], **change: Any) -> tuple[Any, Any]:
    """Outputs and posteriors of a tracker."""
    tracker: Tracker = world.tracker(**config(**change))
    track = tracker.track("vue_1")
    track.record()
    outputs = []
    for epoch in epochs:
        for m in epoch:
            tracker.add(m)
        outputs += tracker.process()
    outputs += tracker.flush()
    return outputs, track._state.estimator.recorder.posteriors


def squared_errors(odometry: list[Odometry], truth: dict[int, Array]) -> Array:
    found = [o for o in odometry if o.stamp_ns in truth]
    return np.array([np.sum((o.position[:2] - truth[o.stamp_ns][POSITION]) ** 2) for o in found])


def nees(odometry: list[Odometry], truth: dict[int, Array]) -> Array:
    values = []
    for o in odometry:
        d = o.position[:2] - truth[o.stamp_ns][POSITION]
        values.append(d @ np.linalg.solve(o.pose_cov[:2, :2], d))
    return np.array(values)


@pytest.mark.parametrize("filter_name", ["iekf", "srukf"])
def test_smoothing_gains_and_stays_consistent(world: Any, filter_name: str) -> None:
    filtered, smoothed, scores = [], [], []
    for seed in range(10):
        truth, epochs = drive(world, seed)
        outputs, posteriors = run(world, epochs, filter=filter_name)
        result = Smoother("vue_1", TrackerConfig(**config())).interval(posteriors)
        assert [o.stamp_ns for o in result] == [p.stamp_ns for p in posteriors]
        filtered.append(squared_errors([o.odometry for o in outputs if o.odometry], truth))
        smoothed.append(squared_errors(result, truth))
        scores.append(nees(result, truth)[::30])  # far apart: nearly independent
    gain = math.sqrt(np.concatenate(filtered).mean() / np.concatenate(smoothed).mean())
    assert gain > 1.3
    score = np.concatenate(scores)
    low, high = chi2.ppf([0.0005, 0.9995], 2 * score.size) / score.size
    assert low < score.mean() < high


def test_last_epoch_is_the_filters(world: Any) -> None:
    _, epochs = drive(world, 1)
    outputs, posteriors = run(world, epochs)
    last = Smoother("vue_1", TrackerConfig(**config())).interval(posteriors)[-1]
    np.testing.assert_array_equal(last.position, outputs[-1].odometry.position)
    np.testing.assert_array_equal(last.pose_cov[:2, :2], outputs[-1].odometry.pose_cov[:2, :2])


def test_segments_are_smoothed_apart(world: Any) -> None:
    """What comes after a new first fix says nothing about the time before."""
    _, epochs = drive(world, 2)
    smoother = Smoother("vue_1", TrackerConfig(**config()))
    _, posteriors = run(world, epochs)
    first = posteriors[:60]
    other = [
        Posterior(p.stamp_ns, p.segment + 1, p.mean + 1e3, p.cov, p.motion, p.bias)
        for p in posteriors[60:]
    ]
    alone, both = smoother.interval(first), smoother.interval(first + other)
    for a, b in zip(alone, both, strict=False):
        np.testing.assert_array_equal(a.position, b.position)


def test_a_bias_first_heard_late_is_unknown_before(world: Any) -> None:
    """The RSU with a bias appears in mid-run: the state grows, and smoothing pads it."""
    from dataclasses import replace  # noqa: PLC0415

    info = replace(world.rsus["c"], range_bias_sd_m=2.0, bias_correlation_time_s=1e3)
    world.rsus["c"] = info
    world.biases["c"] = 1.5
    truth, epochs = drive(world, 3)
    heard = [[m for m in e if m.rsu_id != "c" or k > 70] for k, e in enumerate(epochs)]
    heard = [[replace(m, expected=len(e)) for m in e] for e in heard]
    outputs, posteriors = run(world, heard)
    assert posteriors[10].mean.size == 6
    assert posteriors[-1].mean.size == 7
    assert posteriors[-1].mean[6] == pytest.approx(1.5, abs=0.5)
    result = Smoother("vue_1", TrackerConfig(**config())).interval(posteriors)
    assert len(result) == len(posteriors)
    assert (
        squared_errors(result, truth).mean()
        < squared_errors([o.odometry for o in outputs if o.odometry], truth).mean()
    )


def test_fixed_lag_gives_each_epoch_once_and_a_long_lag_is_the_interval(world: Any) -> None:
    truth, epochs = drive(world, 4)
    outputs, posteriors = run(world, epochs, fixed_lag_s=1.0)
    given = [o for output in outputs for o in output.smoothed]
    stamps = [o.stamp_ns for o in given]
    assert stamps == sorted(set(stamps))
    newest = outputs[-1].status.stamp_ns
    assert stamps == [p.stamp_ns for p in posteriors if p.stamp_ns <= newest - 1_000_000_000]
    known = [o.odometry for o in outputs if o.odometry and o.odometry.stamp_ns in set(stamps)]
    assert squared_errors(given, truth).mean() < squared_errors(known, truth).mean()

    smoother = Smoother("vue_1", TrackerConfig(**config()))
    whole = smoother.interval(posteriors)
    lag = PosteriorRecorder("vue_1", TrackerConfig(**config(fixed_lag_s=14.0)))
    late = [o for p in posteriors for o in lag.note(p)]
    window = [p for p in posteriors if p.stamp_ns - posteriors[0].stamp_ns <= 14_000_000_000]
    np.testing.assert_allclose(late[0].position, smoother.interval(window)[0].position, atol=1e-9)
    assert abs(late[0].position[0] - whole[0].position[0]) < 0.05


def test_fixed_lag_takes_corrections_of_late_measurements(world: Any) -> None:
    """One measurement 0.5 s late: the epochs within the lag come out as if it had been in time."""
    _, epochs = drive(world, 5)
    in_order, _ = run(world, epochs, fixed_lag_s=2.0)
    late = epochs[80].pop()
    epochs[85].append(late)
    tracker: Tracker = world.tracker(**config(fixed_lag_s=2.0))
    disturbed = []
    for epoch in epochs:
        for m in epoch:
            tracker.add(m)
        disturbed += tracker.process()
    disturbed += tracker.flush()
    expected = {o.stamp_ns: o for output in in_order for o in output.smoothed}
    found = {o.stamp_ns: o for output in disturbed for o in output.smoothed}
    for stamp in (epochs[k][0].stamp_ns for k in (70, 80, 84, 90, 120)):
        np.testing.assert_array_equal(found[stamp].position, expected[stamp].position)


def test_interacting_models_are_refused() -> None:
    with pytest.raises(ValueError, match="interacting cannot be smoothed"):
        Smoother("vue_1", TrackerConfig(motion_model="interacting"))
    with pytest.raises(ValueError, match="fixed_lag_s must be 0"):
        TrackerConfig(motion_model="interacting", fixed_lag_s=1.0)
