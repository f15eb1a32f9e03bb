"""Scores of dead reckoning on made-up references whose answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.evaluation.pedestrian import (
    ContactScore,
    heading_and_tilt_error,
    score_contacts,
    score_walk,
)
from netpos.inertial.loaders import ImuRecord, WalkingBout, WaypointRecord
from netpos.inertial.pdr_output import StepEvent
from scipy.spatial.transform import Rotation

MS = 1_000_000


def bout(*contacts_ms: int, untimed: tuple[tuple[int, int, int], ...] = ()) -> WalkingBout:
    stamps = np.array(contacts_ms, dtype=np.int64) * MS
    slots = tuple((a * MS, b * MS, n) for a, b, n in untimed)
    return WalkingBout(int(stamps[0]), int(stamps[-1]), 1.0, stamps, slots)


@pytest.mark.parametrize(
    ("detected_ms", "expected"),
    [
        ([1000, 1600, 2200], ContactScore(3, 3, 0, 0)),
        ([1150, 1450, 2350], ContactScore(3, 2, 0, 0)),  # at the tolerance; the last is outside
        ([1151, 1600, 2200], ContactScore(3, 2, 1, 0)),
        ([1000, 1010, 1600, 2200], ContactScore(3, 3, 1, 0)),  # one detection, one contact
        ([500, 1000, 1900, 2900], ContactScore(3, 1, 1, 0)),  # outside the bout does not count
        ([], ContactScore(3, 0, 0, 0)),
    ],
)
def test_contacts_by_hand(detected_ms: list[int], expected: ContactScore) -> None:
    score = score_contacts(np.array(detected_ms, dtype=np.int64) * MS, [bout(1000, 1600, 2200)])
    assert score == expected


def test_contacts_without_a_time_excuse_one_detection_each() -> None:
    reference = bout(1000, 3000, untimed=((1000, 3000, 2),))
    detected = np.array([1000, 1500, 2000, 2500, 3000]) * MS
    assert score_contacts(detected, [reference]) == ContactScore(2, 2, 1, 2)


def event(end_s: float, length_m: float, heading_rad: float) -> StepEvent:
    end = round(end_s * 1e9)
    return StepEvent(
        stamp_ns=end,
        start_ns=end - 10**9,
        end_ns=end,
        count=1,
        length_m=length_m,
        heading_rad=heading_rad,
        heading_sd_rad=0.1,
        length_sd_m=0.1,
        cadence_hz=1.0,
        heading_reference="map",
    )


@pytest.mark.parametrize("turn_deg", [0.0, 100.0, -170.0])
@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_a_walk_is_aligned_by_turn_and_shift_alone(turn_deg: float, scale: float) -> None:
    """Ten steps of 1 m east, ten north: 10 % longer steps show as 10 % of distance."""
    turn = math.radians(turn_deg)
    headings = [0.0] * 11 + [math.pi / 2] * 10
    events = [event(float(i), scale, h - turn) for i, h in enumerate(headings)]
    record = WaypointRecord(
        ImuRecord(np.zeros(0, dtype=np.int64), None, np.zeros((0, 3)), None),
        np.array([0, 10, 20]) * 10**9,
        np.array([[5.0, 7.0], [15.0, 7.0], [15.0, 17.0]]),
    )
    score = score_walk(events, record)
    assert score.steps == 21
    assert score.distance_m == pytest.approx(20 * scale)
    assert score.true_distance_m == pytest.approx(20.0)
    assert math.remainder(score.turn_rad - turn, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    centred = np.array([[-20 / 3, -10 / 3], [10 / 3, -10 / 3], [10 / 3, 20 / 3]])
    errors = np.hypot(*((scale - 1) * centred).T)
    assert score.max_m == pytest.approx(errors.max(), abs=1e-9)
    assert score.rmse_m == pytest.approx(math.sqrt(np.mean(errors**2)), abs=1e-9)


@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_heading_and_tilt_are_split(flip: float) -> None:
    rng = np.random.default_rng(3)
    truth = Rotation.random(50, rng=rng)
    turn = Rotation.from_rotvec([0.0, 0.0, -0.4])
    tilt = Rotation.from_rotvec([0.05, 0.02, 0.0])
    ours = flip * (turn * truth).as_quat()[:, [3, 0, 1, 2]]
    heading, none = heading_and_tilt_error(ours, truth.as_quat()[:, [3, 0, 1, 2]])
    np.testing.assert_allclose(heading, -0.4)
    np.testing.assert_allclose(none, 0.0, atol=1e-7)
    ours = flip * (tilt * truth).as_quat()[:, [3, 0, 1, 2]]
    heading, tilted = heading_and_tilt_error(ours, truth.as_quat()[:, [3, 0, 1, 2]])
    np.testing.assert_allclose(heading, 0.0, atol=1e-9)
    np.testing.assert_allclose(tilted, math.hypot(0.05, 0.02))
