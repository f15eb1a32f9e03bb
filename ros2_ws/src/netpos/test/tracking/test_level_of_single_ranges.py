"""Anchors heard one after the other: the protection level of a device that turns without notice
holds its errors, and says something."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from netpos.messages.values import Array, InitialPose, TrackState
from netpos.tracking import TrackerConfig
from single_ranges import single_range, tracker_of

STEP_S, SD_M, DURATION_S, HEIGHT_M = 0.01, 0.2, 60.0, 1.0


class Network(NamedTuple):
    """Anchors (n, 3) m, ranges per second of all together, speed of the device, and the half
    width of the square in which it drives."""

    anchors: Array
    rate_hz: float
    speed_mps: float
    half_m: float


def around(count: int) -> Array:
    angle = 2.0 * np.pi * (np.arange(count) + 0.3) / count
    return np.column_stack([40.0 * np.cos(angle), 30.0 * np.sin(angle), np.full(count, 4.0)])


ON_A_CAR = np.array([[x, y, 1.0] for x in (2.6, -2.6) for y in (2.0, -2.0)])
NETWORKS = {
    "yard": Network(around(4), 20.0, 5.0, 25.0),
    "seldom": Network(around(4), 4.0, 5.0, 25.0),
    "on a car": Network(ON_A_CAR, 36.0, 1.5, 20.0),
    "on a car, fast": Network(ON_A_CAR, 36.0, 5.0, 30.0),
}


def drive(rng: np.random.Generator, network: Network) -> Array:
    """(n, 2) m: straight on, with sudden turns by 90 degrees, about one in 15 s, and back at the
    edge. The model expects one in 30 s."""
    place, heading = np.array([6.0, 0.0]), rng.uniform(0.0, 2.0 * math.pi)
    turn_s, places = rng.exponential(15.0), []
    for k in range(round(DURATION_S / STEP_S)):
        places.append(place)
        way = np.array([math.cos(heading), math.sin(heading)])
        place = place + STEP_S * network.speed_mps * way
        if np.abs(place).max() > network.half_m:
            place = np.clip(place, -network.half_m, network.half_m)
            heading = math.atan2(-place[1], -place[0]) + rng.uniform(-0.6, 0.6)
        elif k * STEP_S > turn_s:
            heading += rng.choice([-1.0, 1.0]) * math.pi / 2.0
        else:
            continue
        turn_s = k * STEP_S + 2.0 + rng.exponential(15.0)
    return np.array(places)


def tracked(network: Network, seed: int) -> tuple[Array, Array]:
    """Errors and levels [m] while TRACKING."""
    rng = np.random.default_rng(seed)
    places, period_s = drive(rng, network), 1.0 / network.rate_hz
    tracker = tracker_of(TrackerConfig(device_height_m=HEIGHT_M), network.anchors)
    errors, levels, at_s = [], [], 0.0
    for k in range(round(0.9 * DURATION_S * network.rate_hz)):
        at_s += 0.7 * period_s + 0.3 * rng.exponential(period_s)
        i = k % len(network.anchors)
        place = places[round(at_s / STEP_S)]
        distance = math.dist((*place, HEIGHT_M), network.anchors[i])
        range_m = max(distance + rng.normal(0.0, SD_M), 0.01)
        tracker.add(single_range(k, i, at_s, range_m, SD_M))
        for output in tracker.process():
            if output.status.state is not TrackState.TRACKING:
                continue
            assert output.odometry is not None
            then = places[round((output.odometry.stamp_ns * 1e-9 - 1.0) / STEP_S)]
            errors.append(math.dist(output.odometry.position[:2], then))
            levels.append(output.status.protection_level_m)
    return np.array(errors), np.array(levels)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_level_holds_errors_after_turns_and_is_of_their_size(name: str) -> None:
    """One error in 10,000 may be above the level of a device that turns as often as the model
    says; this one turns twice as often."""
    errors, levels = np.concatenate([tracked(NETWORKS[name], s) for s in (1, 2, 3)], axis=1)
    assert errors.size > 0.9 * 3 * 0.85 * DURATION_S * NETWORKS[name].rate_hz
    assert (errors > levels).sum() <= 1 + 2e-4 * errors.size
    assert np.median(levels) < 3.0 * errors.max()
    assert np.median(levels) < 6.0


def test_the_mean_of_a_ring_is_no_place() -> None:
    """One anchor, and a device that may be anywhere round it: the estimate is the mean of a ring,
    where the device cannot be."""
    tracker = tracker_of(TrackerConfig(), np.zeros((1, 3)))
    pose = InitialPose(
        stamp_ns=1_000_000_000, vue_id="vue_1", position=np.array([4.0, -3.0, 0.0]), cov=np.eye(3)
    )
    tracker.add(pose)
    outputs = []
    for k, at_s in enumerate((0.5, 1.5, 2.5, 4.0, 6.0, 8.0, 10.0, 30.0)):
        tracker.add(single_range(k, 0, at_s, 5.0, 1.0))
        outputs += tracker.process()
    last = [*outputs, *tracker.flush()][-1]
    assert last.odometry is not None
    assert math.hypot(*last.odometry.position[:2]) < 3.0
    assert last.status.state is TrackState.INITIALISING
    assert "their mean" in last.status.reason
