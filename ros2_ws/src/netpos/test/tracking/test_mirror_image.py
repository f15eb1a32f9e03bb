"""Tracks by RSUs that do not tell a device from its mirror image, against the truth and against
tracks that were given the side."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import (
    Array,
    Field,
    InitialPose,
    RsuInfo,
    RsuMeasurement,
    TrackMode,
    TrackState,
)
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.report import TrackOutput

START_NS = 1_000_000_000
STEP_S = 0.1
SD_M = 0.1
ANCHORS = np.array([[2.6, -0.9, 2.0], [2.3, 0.9, 0.5]])
THIRD = np.array([20.0, -7.0, 1.5])


def way(t_s: float) -> Array:
    """Away from the anchors at a walk, to and fro."""
    return np.array([4.0 + 0.9 * t_s, -3.0 + 6.0 * math.sin(t_s / 8.0)])


def across(t_s: float) -> Array:
    """Through the line of the anchors and back, 5 m to each side."""
    return np.array([2.5 + 5.0 * math.cos(t_s / 5.0), 6.0])


def image(place: Array) -> Array:
    """On the other side of the line of the anchors."""
    point, along = ANCHORS[0, :2], (ANCHORS[1] - ANCHORS[0])[:2]
    along = along / np.hypot(*along)
    away = place - point
    return np.asarray(point + 2.0 * along * (along @ away) - away)


def tracker(**config: Any) -> Tracker:
    values = {"initial_speed_sd_mps": 1.0, "accel_density_mps2_sqrthz": 0.45, **config}
    made = Tracker(TrackerConfig(device_height_m=1.1, coverage_radius_m=60.0, **values))
    for name, place in zip("abc", [*ANCHORS, THIRD], strict=True):
        made.add_rsu(RsuInfo(rsu_id=name, position=place))
    return made


def distance(place: Array, anchor: Array) -> float:
    return math.hypot(*(place - anchor[:2]), 1.1 - anchor[2])


def heard(t_s: float, name: str, value_m: float) -> RsuMeasurement:
    return RsuMeasurement(
        stamp_ns=START_NS + round(t_s * 1e9),
        rsu_id=name,
        vue_id="v",
        expected=1,
        fields=Field.RANGE,
        range_m=value_m,
        range_var=SD_M**2,
    )


def walk(
    made: Tracker, seed: int, seconds: float, late: float = 0.0, moves: Any = way
) -> Iterator[tuple[float, TrackOutput]]:
    """Outputs with an estimate of a walk, heard by the two anchors in turn; a burst of up to 11
    ``late`` values begins with that probability."""
    rng, burst = np.random.default_rng(seed), [0, 0]
    for k in range(round(seconds / STEP_S)):
        t_s, i = k * STEP_S, k % 2
        if rng.random() < late:
            burst[i] = int(rng.integers(3, 12))
        excess = 0.0
        if burst[i] > 0:
            burst[i] -= 1
            excess = 0.5 + rng.exponential(1.5)
        value = distance(moves(t_s), ANCHORS[i]) + rng.normal(0.0, SD_M) + excess
        made.add(heard(t_s, "ab"[i], value))
        for output in made.process():
            if output.odometry is not None:
                yield (output.odometry.stamp_ns - START_NS) * 1e-9, output


def error(output: TrackOutput, place: Array) -> float:
    assert output.odometry is not None
    return math.hypot(*(output.odometry.position[:2] - place))


def is_nearer(mode: TrackMode, place: Array, other: Array) -> bool:
    at = (mode.x_m, mode.y_m)
    return math.dist(at, place) < math.dist(at, other)


@pytest.mark.parametrize("learn_errors", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_two_anchors_never_choose_a_side(seed: int, learn_errors: bool) -> None:
    """However many of their values are late, and however long they are heard: the level has both
    sides, and off the line both weigh the same."""
    shares = []
    for t_s, output in walk(tracker(learn_errors=learn_errors), seed, 45.0, late=0.02):
        place, other, status = way(t_s), image(way(t_s)), output.status
        assert error(output, place) < status.protection_level_m
        assert error(output, other) < status.protection_level_m
        if math.dist(place, other) > 10.0:
            assert status.state is not TrackState.TRACKING
            if status.state is TrackState.AMBIGUOUS:
                shares.append(sum(m.weight for m in status.modes if is_nearer(m, place, other)))
    assert len(shares) > 200
    assert np.median(shares) == pytest.approx(0.5, abs=1e-6)


def test_each_side_is_the_track_that_was_given_that_side() -> None:
    """Within half a standard deviation, once the poses are forgotten."""
    poses = {}
    for name, place in (("right", way(0.0)), ("left", image(way(0.0)))):
        made = tracker()
        cov = np.diag([1.0, 1.0, 1e-6])
        position = np.append(place, 1.1)
        made.add(InitialPose(stamp_ns=START_NS - 1, vue_id="v", position=position, cov=cov))
        poses[name] = {t: output for t, output in walk(made, 5, 20.0) if t > 10.0}
    compared = 0
    for t_s, output in walk(tracker(), 5, 20.0):
        if t_s not in poses["right"]:
            continue
        assert len(output.status.modes) == 2
        for given in poses.values():
            odometry = given[t_s].odometry
            assert odometry is not None
            away = [math.dist((m.x_m, m.y_m), odometry.position[:2]) for m in output.status.modes]
            assert min(away) < 0.5 * given[t_s].status.position_sd_m
        compared += 1
    assert compared > 80


@pytest.mark.parametrize("side", [way, lambda t_s: image(way(t_s))])
def test_what_tells_the_sides_apart_decides(side: Any) -> None:
    """Ranges of an anchor off the line, on either side."""
    made = tracker()
    outputs = list(walk(made, 7, 20.0, moves=side))
    assert outputs[-1][1].status.state is TrackState.AMBIGUOUS
    rng, states = np.random.default_rng(70), []
    for k in range(201, 231):
        t_s = k * STEP_S
        name, anchor = ("c", THIRD) if k % 3 == 0 else ("ab"[k % 2], ANCHORS[k % 2])
        made.add(heard(t_s, name, distance(side(t_s), anchor) + rng.normal(0.0, SD_M)))
        states += [(output.status.state, error(output, side(t_s))) for output in made.process()]
    assert all(state is TrackState.TRACKING for state, _ in states[-20:])
    assert max(away for _, away in states[-20:]) < 0.5


def test_a_pose_decides() -> None:
    made = tracker()
    *_, (t_s, last) = walk(made, 9, 20.0)
    assert last.status.state is TrackState.AMBIGUOUS
    position, cov = np.append(way(t_s), 1.1), np.diag([1.0, 1.0, 1e-6])
    stamp_ns = START_NS + round(t_s * 1e9) + 1
    made.add(InitialPose(stamp_ns=stamp_ns, vue_id="v", position=position, cov=cov))
    for k in range(201, 240):
        t_s = k * STEP_S
        made.add(heard(t_s, "ab"[k % 2], distance(way(t_s), ANCHORS[k % 2])))
        outputs = list(made.process())
    assert outputs[-1].status.state is TrackState.TRACKING
    assert error(outputs[-1], way(t_s)) < 0.5


def test_on_the_line_the_sides_are_one_place_and_beyond_it_two_again() -> None:
    states: dict[str, list[TrackState]] = {"near": [], "far": []}
    for t_s, output in walk(tracker(), 3, 40.0, moves=across):
        assert error(output, across(t_s)) < output.status.protection_level_m
        off = math.dist(across(t_s), image(across(t_s))) / 2.0
        if t_s > 5.0 and off > 2.5:
            states["far"].append(output.status.state)
        if off < 0.1:
            states["near"].append(output.status.state)
    assert len(states["near"]) > 3
    assert TrackState.TRACKING in states["near"]
    assert TrackState.AMBIGUOUS in states["far"]
    assert TrackState.TRACKING not in states["far"]
