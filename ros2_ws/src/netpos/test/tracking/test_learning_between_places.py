"""Anchors in one line leave two places until one beside the line is heard: until then nothing is
learned, and what is learned then is not what a range is wrong by between the places."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.messages.values import Array, TrackState
from netpos.tracking import TrackerConfig
from single_ranges import single_range, tracker_of

ANCHORS = np.array([[2.6, 0.9, 2.0], [2.6, -0.9, 2.0], [2.6, -0.9, 0.5], [0.7, 0.9, 0.5]])
IN_LINE, BESIDE_FROM_S = 3, 40.0
RATE_HZ, SD_M, HEIGHT_M, DURATION_S = 20.0, 0.1, 1.1, 60.0
CONFIG = TrackerConfig(
    device_height_m=HEIGHT_M,
    coverage_radius_m=60.0,
    initial_speed_sd_mps=1.0,
    accel_density_mps2_sqrthz=0.45,
    learn_errors=True,
)


def place(at_s: float) -> Array:
    """Away from the anchors and to and fro, on one side of their line."""
    return np.array([6.0 + 0.5 * at_s, -4.0 + 3.0 * math.sin(at_s / 6.0)])


@pytest.mark.parametrize("seed", [1, 2])
def test_two_places_teach_no_errors_that_are_not_there(seed: int) -> None:
    rng, tracker = np.random.default_rng(seed), tracker_of(CONFIG, ANCHORS)
    scatters: list[float] = []
    states: list[tuple[float, TrackState]] = []
    for k in range(round(DURATION_S * RATE_HZ)):
        at_s = k / RATE_HZ
        i = k % (len(ANCHORS) if at_s >= BESIDE_FROM_S else IN_LINE)
        distance = math.dist((*place(at_s), HEIGHT_M), ANCHORS[i])
        tracker.add(single_range(k, i, at_s, distance + rng.normal(0.0, SD_M), SD_M))
        for output in tracker.process():
            scatters += [value for one in output.errors for value in one.scatter]
            if output.odometry is None:
                continue
            states.append((at_s, output.status.state))
            error_m = math.dist(
                output.odometry.position[:2], place(output.status.stamp_ns / 1e9 - 1.0)
            )
            if output.status.state is TrackState.TRACKING:
                assert error_m < output.status.protection_level_m
    ambiguous = [state for at_s, state in states if 2.0 < at_s < BESIDE_FROM_S]
    assert set(ambiguous) == {TrackState.AMBIGUOUS}
    assert states[-1][1] is TrackState.TRACKING
    assert len(scatters) > 50
    assert max(scatters) < 1.6
