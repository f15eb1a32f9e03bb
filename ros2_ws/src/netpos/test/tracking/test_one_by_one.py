"""RSUs that are heard one after the other, and one alone: a late value is not a turn, and no place
beside the RSU is a first fix."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from netpos.messages.values import RsuInfo, TrackState
from netpos.tracking import TrackerConfig
from single_ranges import single_range, tracker_of

ANCHORS = np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [30.0, 55.0, 0.0]])
STEP_S, SD_M = 0.15, 0.2


def errors_of(seed: int) -> list[float]:
    """Errors [m] of a car at 8 m/s after nine seconds, where every eleventh range is late by 5 to
    9 m and nobody says so. None that is TRACKING is above the level."""
    rng = np.random.default_rng(seed)
    tracker = tracker_of(
        TrackerConfig(learn_errors=True, accel_density_mps2_sqrthz=1.0, initial_speed_sd_mps=8.0),
        ANCHORS,
    )
    errors = []
    for k in range(400):
        angle, i = 8.0 * k * STEP_S / 18.0, k % len(ANCHORS)
        place = np.array([30.0, 20.0]) + 18.0 * np.array([np.cos(angle), np.sin(angle)])
        late_m = rng.uniform(5.0, 9.0) if k % 11 == 10 else 0.0
        range_m = float(np.linalg.norm(place - ANCHORS[i, :2]) + SD_M * rng.normal() + late_m)
        tracker.add(single_range(k, i, k * STEP_S, range_m, SD_M))
        for output in tracker.process():
            if output.odometry is None or k < 60:
                continue
            errors.append(float(np.linalg.norm(output.odometry.position[:2] - place)))
            if output.status.state is TrackState.TRACKING:
                assert errors[-1] < output.status.protection_level_m
    return errors


def test_a_late_value_does_not_lead_the_track_away() -> None:
    """1.07 m where each of them may be a turn from before a component that says so began."""
    errors = np.concatenate([errors_of(seed) for seed in range(8)])
    assert len(errors) == 8 * 340
    assert np.sqrt(np.mean(np.square(errors))) < 0.9


@pytest.mark.parametrize("walk", [0.0, 1e-10])
def test_one_rsu_that_hears_a_device_pass_does_not_place_it_beside_itself(
    walk: float, world: Any, feed: Any
) -> None:
    """Directions and times of a clock that drifts evenly, which is declared or nobody knows (0):
    beside the RSU anything fits. Devices pass 12 m from it at 4 m/s; the change of the times tells
    the distance. Where the most probable place was the fix, 10 of 16 were TRACKING above the level
    at some time."""
    world.rsus = {"a": RsuInfo(rsu_id="a", position=np.zeros(3))}
    world.angle_sd, world.range_sd = 0.005, 0.003
    config = {"accel_density_mps2_sqrthz": 0.1, "initial_speed_sd_mps": 3.0}
    ways_above, tracking = 0, 0
    for seed in range(16):
        world.rng = np.random.default_rng(seed)
        tracker, above = world.tracker(clock_walk_density=walk, **config), 0
        for k in range(200):
            t_s = 0.05 * k
            state = np.array([4.0 * t_s - 20.0, 12.0, 4.0, 0.0, 9.0 + 3.0 * t_s, 3.0])
            for output in feed(tracker, world.measure(t_s, state)):
                if output.odometry is not None and output.status.state is TrackState.TRACKING:
                    off_m = float(np.linalg.norm(output.odometry.position[:2] - state[:2]))
                    tracking += 1
                    above += off_m > output.status.protection_level_m
        ways_above += above > 0
    assert ways_above == 0
    assert tracking > 16 * 50
