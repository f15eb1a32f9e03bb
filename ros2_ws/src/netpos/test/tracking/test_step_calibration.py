"""What is wrong with all steps of a person, estimated by the track: length factor and heading
offset."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from netpos.estimation.measurement import BIAS, COMMON, KIND, Kind
from netpos.estimation.state import POSITION, VELOCITY
from netpos.messages.values import Array, Field, StepCalibration, Velocity
from netpos.tracking import TrackerConfig
from netpos.tracking.estimators.epoch_rows import epoch_rows_of
from netpos.tracking.rsus.rsu import BiasStates, StepErrors
from scipy.stats import chi2

T0 = 1_000_000_000
SDS = {"step_length_factor_sd": 0.1, "step_heading_offset_sd_rad": 0.1}
WALK = {"accel_density_mps2_sqrthz": 0.3, "initial_speed_sd_mps": 1.5}
SPEED_MPS, STEP_S, STEP_SD_MPS = 1.2, 0.6, 0.05


def true_state(t_s: float) -> Array:
    """Round a circle of 10 m about (60, 0)."""
    angle = SPEED_MPS * t_s / 10.0
    c, s = math.cos(angle), math.sin(angle)
    return np.array([60 + 10 * c, 10 * s, -SPEED_MPS * s, SPEED_MPS * c, 0.0, 0.0])


def step(t_s: float, factor: float, offset: float, noise: Array, **change: Any) -> Velocity:
    """The velocity on the circle as steps report it; see ``reported``."""
    return reported(t_s, true_state(t_s)[2:4], factor, offset, noise, **change)


def reported(
    t_s: float, v: Array, factor: float, offset: float, noise: Array, **change: Any
) -> Velocity:
    """The velocity that steps ``factor`` longer than reported, ``offset`` to the left of their
    reported heading, are reported with."""
    c, s = math.cos(offset), math.sin(offset)
    return Velocity(
        stamp_ns=T0 + round(t_s * 1e9),
        vue_id="vue_1",
        velocity=np.array([[c, s], [-s, c]]) @ v / factor + STEP_SD_MPS * noise,
        cov=STEP_SD_MPS**2 * np.eye(2),
        **change,
    )


def test_factor_and_offset_are_found_within_their_sd(world: Any, feed: Any) -> None:
    """People drawn from the tracker's own model: the normalised errors of factor and offset, with
    their correlation, are chi-square, and what is left in doubt is a fraction of the prior."""
    density, runs, distance = WALK["accel_density_mps2_sqrthz"], 15, 0.0
    root = np.linalg.cholesky([[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]])
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        world.rng, world.range_sd = rng, 0.1
        k, offset = 0.1 * rng.normal(size=2)
        x = np.array([60.0, 0.0, 1.0, 1.0, 0.0, 0.0])
        tracker = world.tracker(**WALK, **SDS)
        for i in range(1, 45):
            x[POSITION] += STEP_S * x[VELOCITY]
            jolt = density * root @ rng.normal(size=(2, 2))
            x[POSITION], x[VELOCITY] = x[POSITION] + jolt[0], x[VELOCITY] + jolt[1]
            noise = rng.normal(size=2)
            feed(tracker, [reported(i * STEP_S, x[VELOCITY], math.exp(k), offset, noise)])
            (output,) = feed(tracker, world.measure(i * STEP_S, x, Field.RANGE))
        found = output.status.steps
        off = math.log(found.length_factor) - k, found.heading_offset_rad - offset
        sd = found.length_factor_sd / found.length_factor, found.heading_offset_sd_rad
        distance += (off[0] / sd[0]) ** 2 + (off[1] / sd[1]) ** 2
        assert max(sd) < 0.04
    low, high = chi2.ppf([0.001, 0.999], 2 * runs)
    assert low < distance < high


def test_one_of_them_alone_is_found(world: Any, feed: Any) -> None:
    rng = np.random.default_rng(5)
    world.rng, world.range_sd = rng, 0.1
    for missing, given in (
        ("step_heading_offset_sd_rad", (1.2, 0.0)),
        ("step_length_factor_sd", (1.0, -0.15)),
    ):
        tracker = world.tracker(**{**WALK, **SDS, missing: 0.0})
        for i in range(1, 60):
            t = i * STEP_S
            feed(tracker, [step(t, *given, rng.normal(size=2))])
            (output,) = feed(tracker, world.measure(t, true_state(t), Field.RANGE))
        found = output.status.steps
        assert found.length_factor == pytest.approx(given[0], abs=0.05)
        assert found.heading_offset_rad == pytest.approx(given[1], abs=0.05)
        sds = found.length_factor_sd, found.heading_offset_sd_rad
        assert [sd == 0.0 for sd in sds] == [given[0] == 1.0, given[1] == 0.0]


def test_who_knows_the_steps_finds_the_way_without_ranges(world: Any, feed: Any) -> None:
    """A lap without ranges after a lap with them: the error is a third, and the covariance holds
    it; without the states it does not."""
    errors, nees = {}, {}
    for name, config in (("known", {}), ("unknown", dict.fromkeys(SDS, 0.0))):
        rng = np.random.default_rng(1)
        world.rng, world.range_sd = rng, 0.1
        tracker = world.tracker(**{**WALK, **SDS, **config, "coast_after_s": 100.0})
        for i in range(1, 90):
            t = i * STEP_S
            (output,) = feed(tracker, [step(t, 1.15, 0.1, rng.normal(size=2))])
            if i < 60:
                (output,) = feed(tracker, world.measure(t, true_state(t), Field.RANGE))
        off = output.odometry.position[:2] - true_state(t)[:2]
        errors[name] = float(np.hypot(*off))
        nees[name] = float(off @ np.linalg.solve(output.odometry.pose_cov[:2, :2], off))
    assert errors["known"] < errors["unknown"] / 3
    assert nees["known"] < chi2.ppf(0.999, 2) < nees["unknown"]


def test_late_measurements_change_nothing(world: Any, feed: Any) -> None:
    """Ranges that come 0.6 s late: the same estimates to the last bit as in order."""
    said = []
    for late in (False, True):
        rng = np.random.default_rng(3)
        world.rng = rng
        tracker = world.tracker(**WALK, **SDS)
        held: list[Any] = []
        for i in range(1, 40):
            t = i * STEP_S
            steps = [step(t, 1.1, 0.1, rng.normal(size=2))]
            ranges = world.measure(t, true_state(t), Field.RANGE)
            first, held = (held, ranges) if late else (ranges, [])
            outputs = feed(tracker, first + steps if i > 3 else ranges + steps)
            held = held if i > 3 else []
        outputs = feed(tracker, held) or outputs
        said.append((outputs[-1].status.steps, outputs[-1].odometry.position.tolist()))
    assert said[0] == said[1]


def test_nothing_is_estimated_unless_asked_for(world: Any, feed: Any) -> None:
    tracker = world.tracker(**WALK)
    for i in range(1, 9):
        t = i * STEP_S
        feed(tracker, [step(t, 1.0, 0.0, np.zeros(2))])
        (output,) = feed(tracker, world.measure(t, true_state(t)))
    assert output.status.steps == StepCalibration()
    states = BiasStates()
    epoch_rows = epoch_rows_of([step(1.0, 1.0, 0.0, np.zeros(2))], {}, states)
    assert (epoch_rows.rows[:, KIND] == Kind.LINEAR).all()
    assert states.sd == []


def test_every_source_of_velocities_has_states_of_its_own() -> None:
    states = BiasStates(8, StepErrors(length_sd=0.1, heading_sd_rad=0.2, tau_s=50.0))
    items = [step(1.0, 1.0, 0.0, np.zeros(2), source=name) for name in ("a", "b", "a")]
    rows = epoch_rows_of(items, {}, states).rows
    assert (rows[:, KIND] == Kind.STEP_VELOCITY).all()
    np.testing.assert_array_equal(rows[::2, [BIAS, COMMON]], [[8, 9], [10, 11], [8, 9]])
    np.testing.assert_array_equal(states.arrays(), [[0.1, 0.2, 0.1, 0.2], [50.0] * 4])
    mean, cov = np.arange(12) * 0.01, np.diag(np.arange(12) * 1e-4)
    said = states.step_calibration(mean, cov)
    assert said.length_factor == pytest.approx(math.exp(0.08))
    assert said.length_factor_sd == pytest.approx(math.exp(0.08) * math.sqrt(8e-4))
    assert said.heading_offset_rad == pytest.approx(0.09)
    assert said.heading_offset_sd_rad == pytest.approx(0.03)
    assert states.step_calibration(mean[:8], cov[:8, :8]) == StepCalibration()  # not yet augmented
    twin = states.copy()
    twin.of_steps("c")
    assert len(states.sd) == 4
    assert len(twin.sd) == 6


def test_before_the_first_fix_they_widen_the_velocity() -> None:
    """0.1 of 2 m/s along, 0.05 rad of it across; sd of the velocity 0.5 m/s."""
    states = BiasStates(6, StepErrors(length_sd=0.1, heading_sd_rad=0.05, tau_s=1.0))
    item = Velocity(stamp_ns=1, vue_id="v", velocity=np.array([2.0, 0.0]), cov=0.25 * np.eye(2))
    epoch_rows = epoch_rows_of([item], {}, states)
    np.testing.assert_allclose(epoch_rows.slow_variance(states), [0.2**2 / 0.25, 0.1**2 / 0.25])


@pytest.mark.parametrize("name", sorted(SDS))
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"filter": "kf"}, "filter kf is linear"),
        ({"motion_model": "strapdown"}, "takes no step velocities"),
    ],
)
def test_where_it_cannot_be_is_refused(change: dict[str, Any], words: str, name: str) -> None:
    with pytest.raises(ValueError, match=words):
        TrackerConfig(**change, **{name: 0.1})
