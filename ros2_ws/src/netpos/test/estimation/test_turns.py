"""A turn that nothing has shown yet: which epochs leave it open, and how wide the level is."""

from __future__ import annotations

import math

import filter_rows
import numpy as np
import pytest
from netpos.estimation.measurement import Kind, linearise
from netpos.estimation.mixture.gaussians import moments, one_component
from netpos.estimation.mixture.turns import leaves_turns_open, may_have_turned
from netpos.estimation.rows import linear_rows
from netpos.messages.values import Array
from netpos.tracking import TrackerConfig
from netpos.tracking.estimators.estimates import Estimate

MEAN = np.array([3.0, -2.0, 1.0, 0.5, 0.0, 0.0])
NO_BIAS = np.zeros((2, 0))
SD_M, SPEED = 0.3, 4.0
CONFIG = TrackerConfig(
    manoeuvre_speed_sd_mps=SPEED, accel_density_mps2_sqrthz=0.5, device_height_m=0.0
)


def range_from(x: float, y: float, group: int = 0) -> Array:
    """A range of what it should be to an RSU far away, so that its line is straight."""
    distance = math.hypot(x - MEAN[0], y - MEAN[1])
    return filter_rows.row(Kind.RANGE, distance, SD_M**2, group, (x, y, 0.0))[None]


EAST, NORTH, WEST = (1e6, 0.0), (0.0, 1e6), (-1e6, 0.0)


def is_open(*rows: Array) -> bool:
    """Whether an epoch of one group for each of ``rows`` leaves a turn open."""
    _, H = linearise(np.vstack(rows), MEAN, 0.0)
    found: bool = leaves_turns_open(H, len(rows))
    return found


def test_an_epoch_that_sees_one_direction_leaves_a_turn_open() -> None:
    assert is_open(range_from(*EAST))
    assert is_open(range_from(*EAST), range_from(*WEST, 1))
    assert not is_open(range_from(*EAST), range_from(*NORTH, 1))


def test_a_steep_row_is_no_more_than_a_direction() -> None:
    """An angle of an array at arm's length turns by tens of radians per metre."""
    H = np.zeros((2, 6))
    H[0, 0], H[1, 1] = 1e4, 1.0
    assert not leaves_turns_open(H, 2)


def test_a_measured_velocity_leaves_none_open() -> None:
    H = np.zeros((2, 6))
    H[:, 2:4] = np.eye(2)
    assert not is_open(linear_rows(MEAN[2:4], 0.01 * np.eye(2), H, 0))


def test_a_turn_at_any_time_widens_and_moves_nothing() -> None:
    cov = np.diag([0.04, 0.09, 0.2, 0.3, 1.0, 1.0])
    told = may_have_turned(one_component(MEAN, cov), 0.6, SPEED)
    share = 0.6 / 30.0
    np.testing.assert_allclose(np.exp(told.log_weights), [1.0 - share, share], rtol=1e-12)
    mean, widened = moments(told)
    np.testing.assert_allclose(mean, MEAN, rtol=1e-12)
    expected = cov.copy()
    for p in (0, 1):  # a step of the velocity at a time that is uniform in the last 0.6 s
        expected[p, p] += share * (SPEED * 0.6) ** 2 / 3.0
        expected[p, p + 2] += share * SPEED**2 * 0.3
        expected[p + 2, p] += share * SPEED**2 * 0.3
        expected[p + 2, p + 2] += share * SPEED**2
    np.testing.assert_allclose(widened, expected, rtol=1e-9)


@pytest.mark.parametrize(("open_s", "speed"), [(0.0, SPEED), (1.0, 0.0)])
def test_where_no_turn_is_possible_nothing_changes(open_s: float, speed: float) -> None:
    known = one_component(MEAN, np.eye(6))
    told = may_have_turned(known, open_s, speed)
    for before, after in zip(known, told, strict=True):
        np.testing.assert_array_equal(after, before)


def stepped(estimate: Estimate, at_s: float, *rows: Array) -> float:
    """``undetected_m`` of an epoch."""
    stamp_ns = round(at_s * 1e9)
    return estimate.step(stamp_ns, 0.1, 0, np.vstack(rows), NO_BIAS).undetected_m


def test_the_level_after_one_range_holds_a_turn_of_the_last_moments() -> None:
    """Against draws: of a device that turns as often as the model says, the promised share is
    outside."""
    estimate = Estimate(CONFIG, 0, MEAN, np.diag([0.04, 0.09, 0.2, 0.3, 1.0, 1.0]))
    open_s = 0.2
    moved = MEAN[:2] + open_s * MEAN[2:4]
    ahead = filter_rows.row(
        Kind.RANGE, math.hypot(EAST[0] - moved[0], moved[1]), SD_M**2, 0, (*EAST, 0.0)
    )
    level = stepped(estimate, open_s, ahead)
    assert len(estimate.components.log_weights) == 1
    rng, draws = np.random.default_rng(1), 4_000_000
    error = rng.multivariate_normal(np.zeros(2), estimate.cov[:2, :2], draws)
    turned = np.flatnonzero(rng.random(draws) < open_s / 30.0)
    moved_sd = SPEED * open_s / math.sqrt(3.0)
    error[turned] += rng.normal(0.0, moved_sd, (turned.size, 2))
    outside = (np.hypot(*error.T) > level).mean()
    assert outside == pytest.approx(CONFIG.integrity_risk, rel=0.2)


def test_the_level_grows_while_no_component_says_whether_the_device_turned() -> None:
    """Up to a quarter of a second; then a component does."""
    levels = []
    for open_s in (0.05, 0.15, 0.24, 0.26):
        estimate = Estimate(CONFIG, 0, MEAN, 0.01 * np.eye(6))
        levels.append(stepped(estimate, open_s, range_from(*EAST)))
    assert levels[:3] == sorted(levels[:3])
    assert levels[0] < 0.6
    assert levels[2] > 1.0


def test_an_epoch_that_sees_all_directions_shows_turns_itself() -> None:
    """After a minute with two RSUs a range of one does not open a turn of a minute."""
    estimate = Estimate(CONFIG, 0, MEAN * [1, 1, 0, 0, 0, 0], 0.01 * np.eye(6))
    for k in range(1, 301):
        both = stepped(estimate, 0.2 * k, range_from(*EAST), range_from(*NORTH, 1))
    assert both < 5.0
    alone = stepped(estimate, 60.2, range_from(*EAST))
    assert both < alone < 5.0
    assert math.sqrt(estimate.cov[1, 1]) < 0.5


def test_without_a_gate_several_rsus_never_show_a_turn() -> None:
    config = TrackerConfig(gate_probability=1.0, manoeuvre_speed_sd_mps=SPEED)
    estimate = Estimate(config, 0, MEAN, 0.01 * np.eye(6))
    assert math.isinf(stepped(estimate, 0.1, range_from(*EAST), range_from(*NORTH, 1)))
    assert math.isfinite(stepped(estimate, 0.2, range_from(*EAST)))


def test_a_velocity_too_uncertain_to_show_a_turn_leaves_a_finite_level() -> None:
    H = np.zeros((2, 6))
    H[:, 2:4] = np.eye(2)
    vague = linear_rows(MEAN[2:4], 9.0 * np.eye(2), H, 0)
    estimate = Estimate(CONFIG, 0, MEAN, np.diag([0.04, 0.04, 9.0, 9.0, 1.0, 1.0]))
    levels = [stepped(estimate, 0.2 * k, vague) for k in range(1, 4)]
    assert all(0.5 < level < 50.0 for level in levels)
    assert levels == sorted(levels)
