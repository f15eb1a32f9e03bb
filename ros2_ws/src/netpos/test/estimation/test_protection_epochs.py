"""The level of a manoeuvre that several epochs together would show, against closed forms."""

from __future__ import annotations

import math

import filter_rows
import numpy as np
import pytest
from netpos.estimation.measurement import Kind
from netpos.estimation.protection import level_of_epochs, protection_level
from netpos.estimation.state import POSITION
from netpos.messages.values import Array
from netpos.tracking import TrackerConfig
from netpos.tracking.models import options_of
from scipy import stats

NS = 1_000_000_000
SPEED, SD_M = 4.0, 0.3
OPTIONS = options_of(
    TrackerConfig(gate_probability=0.9999, manoeuvre_speed_sd_mps=SPEED, device_height_m=0.0)
)
MEAN = np.zeros(6)
PRIOR, POSTERIOR = np.diag([0.16, 0.16, 1.0, 1.0, 1.0, 1.0]), np.diag([0.09, 0.04, 1, 1, 1, 1.0])


def range_from(x: float, y: float) -> Array:
    """A range to an RSU far away, so that its line is straight."""
    return filter_rows.row(Kind.RANGE, math.hypot(x, y), SD_M**2, 0, (x, y, 0.0))[None]


EAST, NORTH = range_from(1e6, 0.0), range_from(0.0, 1e6)


def level(*recent: tuple[float, Array]) -> float:
    """Of epochs that end at 10 s."""
    epochs = [(int(at_s * NS), rows) for at_s, rows in recent]
    return level_of_epochs(epochs, 10 * NS, (MEAN, PRIOR), POSTERIOR, OPTIONS)


def expected(epochs: int, age_s: float) -> float:
    """``epochs`` epochs are needed, the oldest ``age_s`` old; each axis is seen once."""
    variance = 0.16 + SD_M**2
    longest_s = math.sqrt(epochs * stats.chi2.ppf(0.9999, 2) * variance) / SPEED + age_s
    moved = (SPEED * longest_s) ** 2 / 3.0
    return protection_level(POSTERIOR[POSITION, POSITION] + moved * np.eye(2), 1e-4)


def test_two_ranges_across_each_other_see_all_directions() -> None:
    assert level((9.9, EAST), (10.0, NORTH)) == pytest.approx(expected(2, 0.1), rel=1e-3)


def test_no_more_epochs_are_taken_than_see_all_directions() -> None:
    assert level((5.0, EAST), (9.9, EAST), (10.0, NORTH)) == pytest.approx(
        expected(2, 0.1), rel=1e-3
    )


def test_an_older_epoch_leaves_more_time() -> None:
    levels = [level((10.0 - age_s, EAST), (10.0, NORTH)) for age_s in (0.1, 1.0, 3.0)]
    assert levels == sorted(levels)
    assert levels[2] == pytest.approx(expected(2, 3.0), rel=1e-3)


@pytest.mark.parametrize("epochs", [1, 5])
def test_along_one_line_nothing_ever_shows(epochs: int) -> None:
    recent = [(10.0 - 0.1 * k, EAST) for k in reversed(range(epochs))]
    assert math.isinf(level(*recent))


def test_without_a_gate_nothing_ever_shows() -> None:
    off = options_of(TrackerConfig(gate_probability=1.0, manoeuvre_speed_sd_mps=SPEED))
    epochs = [(9 * NS, EAST), (10 * NS, NORTH)]
    assert math.isinf(level_of_epochs(epochs, 10 * NS, (MEAN, PRIOR), POSTERIOR, off))
