"""Pairing against closed forms, at its boundaries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from netpos.evaluation.pairing import Trajectory, bracket, pair, wrap_angle
from netpos.messages.values import Odometry

S = 1_000_000_000


def pose(stamp_ns: int, x: float, yaw: float = 0.0, speed: float = 1.0) -> Odometry:
    return Odometry(
        stamp_ns=stamp_ns,
        vue_id="vue_1",
        position=np.array([x, 2.0 * x, 0.0]),
        quaternion=np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]),
        linear_velocity=np.array([speed, 0.0, 0.0]),
    )


def test_truth_is_interpolated_at_the_estimates_stamp() -> None:
    truth = Trajectory.of([pose(0, 0.0, speed=1.0), pose(S, 10.0, speed=3.0)])
    pairs = pair(Trajectory.of([pose(S // 4, 0.0)]), truth)
    np.testing.assert_allclose(pairs.truth.position, [[2.5, 5.0, 0.0]])
    np.testing.assert_allclose(pairs.truth.velocity, [[1.5, 0.0, 0.0]])
    np.testing.assert_allclose(pairs.horizontal_error, [np.hypot(2.5, 5.0)])


@given(st.floats(-3.1, 3.1), st.floats(-3.0, 3.0), st.floats(0.0, 1.0))
def test_heading_follows_the_shorter_arc(start: float, turn: float, share: float) -> None:
    truth = Trajectory.of([pose(0, 0.0, start), pose(S, 0.0, start + turn)])
    stamp = round(share * S)
    pairs = pair(Trajectory.of([pose(stamp, 0.0, start + turn * stamp / S)]), truth)
    difference = np.exp(1j * (pairs.estimate.heading - pairs.truth.heading))
    np.testing.assert_allclose(difference, 1.0, atol=1e-7)


def test_twist_is_turned_into_map_axes() -> None:
    trajectory = Trajectory.of([pose(0, 0.0, np.pi / 2, speed=2.0)])
    np.testing.assert_allclose(trajectory.velocity, [[0.0, 2.0, 0.0]], atol=1e-15)


@pytest.mark.parametrize(("stamp", "paired"), [(S - 1, 0), (S, 1), (2 * S, 1), (2 * S + 1, 0)])
def test_only_estimates_within_the_truths_span(stamp: int, paired: int) -> None:
    truth = Trajectory.of([pose(S, 0.0), pose(2 * S, 1.0)])
    pairs = pair(Trajectory.of([pose(stamp, 0.0)]), truth)
    assert (len(pairs), pairs.outside, pairs.in_gap) == (paired, 1 - paired, 0)


@pytest.mark.parametrize(("gap_ns", "paired"), [(S, 1), (S + 1, 0)])
def test_a_gap_in_the_truth_has_no_pairs_inside(gap_ns: int, paired: int) -> None:
    truth = Trajectory.of([pose(0, 0.0), pose(gap_ns, 1.0)])
    estimate = Trajectory.of([pose(0, 0.0), pose(gap_ns // 2, 0.5), pose(gap_ns, 1.0)])
    pairs = pair(estimate, truth, max_truth_gap_s=1.0)
    assert (len(pairs), pairs.in_gap) == (2 + paired, 1 - paired)


def test_of_two_estimates_with_one_stamp_the_last_counts() -> None:
    trajectory = Trajectory.of([pose(S, 1.0), pose(0, 5.0), pose(S, 2.0)])
    assert trajectory.stamp_ns.tolist() == [0, S]
    assert trajectory.position[:, 0].tolist() == [5.0, 2.0]
    assert trajectory.duplicates == 1


def test_values_that_are_not_finite_are_left_out_and_counted() -> None:
    bad = replace(pose(S, 1.0), position=np.array([np.nan, 0.0, 0.0]))
    unset = replace(pose(2 * S, 1.0), quaternion=np.zeros(4))
    trajectory = Trajectory.of([pose(0, 0.0), bad, unset])
    assert (len(trajectory), trajectory.invalid) == (1, 2)


def test_no_truth_and_no_estimates_give_no_pairs() -> None:
    none, one = Trajectory.of([]), Trajectory.of([pose(0, 0.0)])
    assert pair(one, none).outside == 1
    assert len(pair(none, one)) == 0
    assert len(pair(one, one)) == 1


def test_stamps_of_this_century_keep_their_nanoseconds() -> None:
    base = 1_700_000_000 * S
    bracketed = bracket(np.array([base + 1]), np.array([base, base + 4]))
    assert bracketed.weight.tolist() == [0.25]


@pytest.mark.parametrize("gap", [0.0, -1.0, float("nan")])
def test_gap_must_be_positive(gap: float) -> None:
    with pytest.raises(ValueError, match="max_gap_s must be > 0"):
        bracket(np.array([0]), np.array([0]), gap)


@given(st.floats(-50.0, 50.0))
def test_wrapped_angles_point_the_same_way(angle: float) -> None:
    wrapped = float(wrap_angle(np.array([angle]))[0])
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-12)
