"""How long a velocity step goes unnoticed, against the distance it has to grow to."""

from __future__ import annotations

import math

import filter_rows
import numpy as np
import pytest
from netpos.estimation.level.manoeuvre import (
    add_manoeuvre,
    detection_delay_s,
    measures_velocity,
    side_turns,
    turn_to_side,
)
from netpos.estimation.measurement import (
    AXES,
    COMMON,
    GATE_VARIANCE,
    Kind,
    curvature_variance,
    linearise,
)
from netpos.estimation.rows import linear_rows
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import Array

MEAN = np.array([30.0, 20.0, 5.0, -1.0, 0.0, 0.0])
GATE, SPEED = 13.8, 3.0


def problem(seed: int) -> tuple[Array, Array]:
    """Covariance, and rows of two RSUs; in the gate counts the gate's variance."""
    rng = np.random.default_rng(seed)
    rows = [
        filter_rows.row(kind, 0.3, 9.0, 0, rng.uniform(-20, 20, 3), gate_variance=variance)
        for kind, variance in ((Kind.AZIMUTH, 1e-3), (Kind.RANGE, 0.2), (Kind.AZIMUTH, 4e-3))
    ]
    return filter_rows.make_cov(rng, 6, 0.5), np.array(rows)


def known(cov: Array, rows: Array) -> Array:
    """What rows tell of the place (2, 2), the prior's own uncertainty taken for noise."""
    _, H = linearise(rows, MEAN, 1.0)
    noise = rows[:, GATE_VARIANCE] + [curvature_variance(r, MEAN, cov, 1.0) for r in rows]
    information: Array = H[:, :2].T @ np.linalg.inv(H @ cov @ H.T + np.diag(noise)) @ H[:, :2]
    return information


def delay_s(cov: Array, rows: Array) -> tuple[float, float]:
    """``detection_delay_s`` of rows that MEAN predicts."""
    predicted = predicted_rows(np.resize(MEAN, len(cov)), cov, rows, 1.0)
    found: tuple[float, float] = detection_delay_s(rows, predicted, len(cov), GATE, SPEED)
    return found


@pytest.mark.parametrize("seed", range(5))
def test_a_step_is_noticed_where_it_reaches_the_gate(seed: int) -> None:
    """In the direction known least, by search over all, and in the mean over them."""
    cov, rows = problem(seed)
    typical_s, longest_s = delay_s(cov, rows)
    angles = np.linspace(0.0, math.pi, 20001)
    ways = np.array([np.cos(angles), np.sin(angles)])
    reached = np.einsum("in,ij,jn->n", ways, known(cov, rows), ways)  # of a step of one metre
    assert longest_s == pytest.approx(math.sqrt(GATE / reached.min()) / SPEED, rel=1e-6)
    typical = math.sqrt(GATE / reached[:-1].mean()) / SPEED
    assert typical_s == pytest.approx(typical, rel=1e-6)


def test_what_no_row_tells_is_never_noticed() -> None:
    """One bearing leaves its own direction open, and no rows everything."""
    cov, rows = problem(1)
    some_s, longest_s = delay_s(cov, rows[:1])
    assert math.isfinite(some_s)
    assert longest_s == math.inf
    assert delay_s(cov, rows[:0]) == (math.inf, math.inf)


def test_an_unknown_clock_hides_no_step_that_several_times_show() -> None:
    """Two RSUs on either side: of a step along the line between them the difference of the two
    times, of 0.2 m, tells what ranges of so much noise would; of one across it nothing does."""
    rows = [
        filter_rows.row(Kind.TOA, 0.0, 0.02, 0, (MEAN[0] + side, MEAN[1], 1.0))
        for side in (-100.0, 100.0)
    ]
    cov = np.diag([0.0, 0.0, 0.0, 0.0, 1e8, 0.0])
    typical_s, longest_s = delay_s(cov, np.array(rows))
    along_s = math.sqrt(GATE * 0.02 / 2.0) / SPEED
    assert typical_s == pytest.approx(math.sqrt(2.0) * along_s, rel=1e-3)
    assert longest_s > 1e3


@pytest.mark.parametrize("seed", range(3))
def test_differences_show_a_step_as_soon_as_times_with_an_unknown_clock(seed: int) -> None:
    """The noise of the reference, a state, is in all differences and tells of no step."""
    rng, variance = np.random.default_rng(seed), 0.09
    reference, *others = rng.uniform(-60.0, 60.0, (5, 3))
    times = [filter_rows.row(Kind.TOA, 0.0, variance, 0, at) for at in (reference, *others)]
    differences = np.array([filter_rows.row(Kind.TDOA, 0.0, variance, 0, at) for at in others])
    differences[:, AXES : AXES + 3] = reference - np.array(others)
    differences[:, COMMON] = 6
    cov = np.zeros((7, 7))
    cov[4, 4], cov[6, 6] = 1e8, variance
    np.testing.assert_allclose(
        delay_s(cov, differences), delay_s(cov[:6, :6], np.array(times)), rtol=1e-5
    )


def test_a_step_at_any_time_moves_the_place_by_half_of_it() -> None:
    """Position and velocity of steps drawn, the time of each any in the last two seconds."""
    rng, cov = np.random.default_rng(2), np.zeros((6, 6))
    step, since_s = rng.normal(0.0, SPEED, 400_000), rng.uniform(0.0, 2.0, 400_000)
    add_manoeuvre(SPEED, 2.0, cov)
    drawn = np.cov(step * since_s, step)
    for axis in (0, 1):
        found = cov[np.ix_([axis, axis + 2], [axis, axis + 2])]
        np.testing.assert_allclose(found, drawn, rtol=0.01)
    cov[:4, :4] -= np.kron(found, np.eye(2))
    np.testing.assert_allclose(cov, 0.0, atol=1e-12)


def velocities(sd: float) -> Array:
    """A measured velocity: two linear rows of variance sd²."""
    return linear_rows(np.zeros(2), sd**2 * np.eye(2), np.eye(2, 6, 2), 0)


def test_a_measured_velocity_shows_a_step_at_once() -> None:
    cov, rows = 0.01 * np.eye(6), velocities(0.1)
    assert delay_s(cov, rows) == (0.0, 0.0)
    _, H = linearise(rows, MEAN, 1.0)
    assert measures_velocity(H)
    assert not measures_velocity(H[:1])
    assert not measures_velocity(linearise(problem(1)[1], MEAN, 1.0)[1])


def test_a_velocity_too_uncertain_to_show_a_step_leaves_it_to_the_positions() -> None:
    """At sd so large that the step is far within the gate, the delay is that of the other rows."""
    cov, rows = problem(2)
    alone = delay_s(cov, rows)
    with_both = np.concatenate([rows, velocities(1e6)])
    both = delay_s(cov, with_both)
    np.testing.assert_allclose(both, alone, rtol=1e-6)
    assert delay_s(cov, velocities(1e6)) == (math.inf, math.inf)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_turn_to_a_side_has_the_moments_of_draws(side: float) -> None:
    """Of states that turn by 90 degrees at any time, then 25 degrees and a quarter of the speed
    more or less."""
    rng, within_s, count = np.random.default_rng(7), 1.5, 400_000
    cov = filter_rows.make_cov(rng, 6, 0.5)
    mean, turned_cov = MEAN.copy(), cov.copy()
    turn_to_side(side, within_s, mean, turned_cov)

    draws = rng.multivariate_normal(MEAN, cov, count)
    left = np.array([[0.0, -side], [side, 0.0]])
    way = left @ MEAN[2:4]
    velocity = draws[:, 2:4] @ left.T
    velocity += np.outer(rng.normal(0.0, 0.25, count), way)
    velocity += np.outer(rng.normal(0.0, math.radians(25.0), count), left @ way)
    age = rng.uniform(0.0, within_s, (count, 1))
    draws[:, :2] += age * (velocity - draws[:, 2:4])
    draws[:, 2:4] = velocity
    sd = np.sqrt(np.diag(turned_cov))
    np.testing.assert_allclose(mean, draws.mean(axis=0), atol=0.01 * sd.max())
    np.testing.assert_allclose(
        turned_cov / np.outer(sd, sd), np.cov(draws.T) / np.outer(sd, sd), atol=0.015
    )


CERTAIN = 1e-4 * np.eye(6)


def test_a_velocity_that_is_not_known_has_no_side() -> None:
    """25 degrees of 4 m/s are 1.75 m/s, of both axes together."""
    along = np.array([0.0, 0.0, 4.0, 0.0, 0.0, 0.0])
    for sd, is_known in ((1.2, True), (1.3, False)):
        assert (side_turns(along, sd**2 * np.eye(6), SPEED) > 0.0) is is_known


def test_turns_to_a_side_are_as_many_as_steps_of_their_size() -> None:
    """Of steps drawn from what is declared, those within a third of the size of the turn, for a
    device that is as fast as declared; hardly any for one that stands, or that is much faster: an
    IMU shows such turns."""
    steps = np.hypot(*np.random.default_rng(1).normal(0.0, SPEED, (2, 400_000)))
    along = MEAN.copy()
    for speed in (0.2 * SPEED, SPEED / math.sqrt(2.0), SPEED):
        along[2:4] = speed, 0.0
        size = math.sqrt(2.0) * speed
        share = (np.abs(steps - size) < 0.35 * size).mean()
        assert side_turns(along, CERTAIN, SPEED) == pytest.approx(share, rel=0.06)
    for speed in (0.0, 3.0 * SPEED):
        along[2:4] = speed, 0.0
        assert side_turns(along, CERTAIN, SPEED) < 2e-3
