"""The paper's rule: its geometry against exact paths, its choice on steps without noise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement, TrackState, Velocity
from netpos.tracking import Tracker, TrackerConfig, TrackOutput
from netpos.tracking.first_fix.step_heading import choose_sector, sector_numbers, sector_tracks
from scipy.spatial.transform import Rotation

LAMBDA = 0.0462
L = 4 * LAMBDA


def paths(xy: Array) -> tuple[Array, Array]:
    """Ranges to the master at (L/2, 0) and phases of the exact path difference."""
    master = np.hypot(xy[..., 0] - L / 2, xy[..., 1])
    slave = np.hypot(xy[..., 0] + L / 2, xy[..., 1])
    return master, 2 * math.pi * (slave - master) / LAMBDA


def step(start: Array, heading: float, samples: int = 7) -> tuple[Array, Array]:
    """Times and positions of a step at 1 m/s."""
    times = np.arange(samples) * 0.1
    return times, start + times[:, None] * [math.cos(heading), math.sin(heading)]


@pytest.mark.parametrize(
    ("wavelengths", "most"), [(0.5, 0), (1.0, 1), (3.9, 3), (4.0, 4), (10.0, 10)]
)
def test_numbers_of_sectors(wavelengths: float, most: int) -> None:
    """petukhov:eq.11: K = 2 (L/lambda - mod) + 1."""
    assert sector_numbers(wavelengths).tolist() == list(range(-most, most + 1))


def test_positions_are_exact() -> None:
    """petukhov:eq.14, 15 have no plane wave in them."""
    xy = np.random.default_rng(1).uniform([-4, 0.5], [4, 7], (50, 2))
    ranges, phases = paths(xy)
    tracks = sector_tracks(ranges, phases, np.array([0]), L, LAMBDA)
    np.testing.assert_allclose(tracks[0], xy, atol=1e-9)


def test_sectors_without_a_place_are_marked() -> None:
    ranges, phases = paths(np.array([[3.0, 1.0]]))
    tracks = sector_tracks(ranges, phases, np.array([-1, 0, 1]), L, LAMBDA)
    assert np.isfinite(tracks[:2]).all()
    assert np.isnan(tracks[2]).any()


@pytest.mark.parametrize("turns", [-3, -1, 0, 2, 3])
def test_the_true_sector_has_the_true_direction(turns: int) -> None:
    """Residuals are 0 in the true sector and grow with the distance from it."""
    sine = (turns + 0.13) / 4
    start = 4.0 * np.array([sine, math.sqrt(1 - sine**2)])
    times, xy = step(start, 0.7)
    ranges, phases = paths(xy)
    wrapped = (phases + math.pi) % (2 * math.pi) - math.pi
    choice = choose_sector(times, ranges, wrapped, 0.7, L, LAMBDA)
    assert choice is not None
    first = round((phases[0] - wrapped[0]) / (2 * math.pi))
    best = choice.turns[np.argmin(choice.residuals)]
    assert best == first
    assert choice.residuals.min() < 1e-3
    assert np.sort(choice.residuals)[1] > 0.1


def test_the_parabola_is_that_of_the_residuals() -> None:
    times, xy = step(np.array([0.2, 4.0]), 1.2)
    ranges, phases = paths(xy)
    choice = choose_sector(times, ranges, phases, 1.2 + 0.05, L, LAMBDA)
    assert choice is not None
    A = np.vander(choice.turns.astype(float), 3)
    expected = np.linalg.lstsq(A, choice.residuals, rcond=None)[0]
    np.testing.assert_allclose(choice.parabola, expected, atol=1e-9)
    a, b, _ = expected
    assert choice.chosen == np.clip(round(-b / (2 * a)), choice.turns[0], choice.turns[-1])


def test_a_heading_on_the_other_side_of_pi_is_near() -> None:
    times, xy = step(np.array([0.2, 4.0]), math.pi - 0.01)
    ranges, phases = paths(xy)
    choice = choose_sector(times, ranges, phases, -math.pi + 0.01, L, LAMBDA)
    assert choice is not None
    assert choice.residuals.min() < 0.03


def test_a_step_across_a_wrap_is_one_step() -> None:
    sine = 1.5 / 4
    times, xy = step(4.0 * np.array([sine, math.sqrt(1 - sine**2)]) - [0.3, 0.0], 0.0)
    ranges, phases = paths(xy)
    wrapped = (phases + math.pi) % (2 * math.pi) - math.pi
    assert np.abs(np.diff(wrapped)).max() > 3.0
    choice = choose_sector(times, ranges, wrapped, 0.0, L, LAMBDA)
    assert choice is not None
    assert choice.residuals.min() < 1e-3


def test_too_little_is_no_choice() -> None:
    one = np.ones(1)
    assert choose_sector(one, one, one, 0.0, L, LAMBDA) is None
    far = np.array([0.01, 0.01])
    assert choose_sector(np.arange(2.0), far, far, 0.0, L, LAMBDA) is None


def test_the_tracker_starts_by_the_rule_after_the_first_step() -> None:
    """A device that stands for half a second, then steps; half a wavelength, so that the rule is
    right and only its timing is tested."""
    info = RsuInfo(
        rsu_id="a",
        position=np.zeros(3),
        quaternion=Rotation.from_euler("z", 90, degrees=True).as_quat(),
        baseline_m=LAMBDA / 2,
        wavelength_m=LAMBDA,
    )
    config: dict[str, Any] = {"ambiguity": "step_heading", "filter": "srukf", "hold_s": 0.0}
    tracker = Tracker(TrackerConfig(**config))
    tracker.add_rsu(info)
    outputs: list[TrackOutput] = []
    xy = np.array([0.5, 3.0])
    for k in range(20):
        stamp, speed = 1_000_000_000 + k * 100_000_000, (0.0 if k < 5 else 1.0 + (k > 11) / 9)
        velocity = Velocity(
            stamp_ns=stamp, vue_id="v", velocity=np.array([0.0, speed]), cov=np.eye(2) * 0.01
        )
        measured = RsuMeasurement(
            stamp_ns=stamp,
            rsu_id="a",
            vue_id="v",
            fields=Field.RANGE | Field.PHASE,
            expected=1,
            range_m=math.hypot(xy[0] - LAMBDA / 4, xy[1]),
            range_var=1e-3,
            phase_difference_rad=math.pi * math.sin(math.atan2(*xy)),
            phase_difference_var=1e-2,
        )
        for item in (velocity, measured):
            assert tracker.add(item) is None
        outputs += tracker.process()
        xy = xy + np.array([0.0, 0.1 * speed])
    states = [o.status.state for o in outputs]
    assert states.index(TrackState.TRACKING) == 12
    assert outputs[11].odometry is None
    last = outputs[-1].odometry
    assert last is not None
    assert np.hypot(*(last.position[:2] - xy + [0.0, 0.1 * 10 / 9])) < 0.15
