"""How much a walker's velocity may change, by what is reported of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Velocity
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.adaptive_process_noise import AdaptiveProcessNoise

NS = 1_000_000_000
FREE, STEADY = 1.0, 0.1


def process_noise(**settings: Any) -> AdaptiveProcessNoise:
    given = {
        "steady_accel_density_mps2_sqrthz": STEADY,
        "gate_probability": 0.9999,
    }
    return AdaptiveProcessNoise(TrackerConfig(**{**given, **settings}))


def report(time_s: float, vx: float, sd: float = 0.05, source: str = "step_velocity") -> Velocity:
    return Velocity(
        stamp_ns=round(time_s * NS),
        vue_id="vue_1",
        velocity=np.array([vx, 0.0]),
        cov=sd**2 * np.eye(2),
        source=source,
    )


def after(walk: AdaptiveProcessNoise, *reports: Velocity) -> float:
    found = 0.0
    for item in reports:
        found = walk.density(item.stamp_ns, FREE, [item])
    return found


def test_equal_steps_are_as_steady_as_they_are_known() -> None:
    found = after(process_noise(), report(1.0, 1.0), report(1.1, 1.0), report(1.2, 1.05))
    assert found == pytest.approx(math.hypot(STEADY, 0.05))
    found = after(process_noise(), report(1.0, 1.0, 0.4), report(1.1, 1.0, 0.3))
    assert found == pytest.approx(math.hypot(STEADY, 0.3))


def test_an_unknown_velocity_is_as_free_as_any() -> None:
    assert after(process_noise(), report(1.0, 0.0, 2.0)) == FREE


def test_what_was_said_lasts_a_second() -> None:
    walk = process_noise()
    after(walk, report(1.0, 1.0))
    assert walk.density(2 * NS, FREE) == pytest.approx(math.hypot(STEADY, 0.05))
    assert walk.density(2 * NS + 1, FREE) == FREE
    assert process_noise().density(NS, FREE) == FREE


def test_a_change_beyond_the_errors_is_a_jump_at_some_time_since() -> None:
    """The variance of a velocity step of random sign and instant, over one interval."""
    found = after(process_noise(), report(1.0, 0.0), report(1.2, 1.0))
    assert found**2 * 0.2 == pytest.approx(1.0 / 2.0 + 0.2 * (STEADY**2 + 0.05**2))


@pytest.mark.parametrize(("distance2", "opens"), [(18.40, False), (18.44, True)])
def test_errors_explain_what_the_gate_accepts(distance2: float, opens: bool) -> None:
    """chi2(0.9999, 2 dof) = 18.42; the sum of both covariances counts."""
    change = math.sqrt(distance2 * (0.05**2 + 0.12**2))
    found = after(process_noise(), report(1.0, 0.0, 0.12), report(1.1, change))
    assert (found > 1.5 * math.hypot(STEADY, 0.05)) is opens


def test_sources_are_compared_with_themselves() -> None:
    walk = process_noise()
    after(walk, report(1.0, 1.0), report(1.05, 0.0, source="other"), report(1.1, 1.0))
    assert walk.density(round(1.1 * NS), FREE) == pytest.approx(math.hypot(STEADY, 0.05))
    assert after(walk, report(1.2, 1.0, source="other")) > 1.0


def test_off_or_with_an_imu_the_motion_model_has_its_own() -> None:
    off = process_noise(steady_accel_density_mps2_sqrthz=0.0)
    assert off.density(NS, 0.7, [report(1.0, 1.0)]) == 0.7
    driven = process_noise(motion_model="inertial")
    assert driven.density(NS, 0.7, [report(1.0, 1.0)]) == 0.7


@pytest.mark.parametrize(
    "settings",
    [
        {"process_noise": "werner"},
        {"process_noise": "white_acceleration"},
        {"motion_model": "interacting"},
        {"motion_model": "constant_acceleration"},
    ],
)
def test_models_without_one_white_acceleration_are_refused(settings: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="steady_accel_density_mps2_sqrthz needs"):
        process_noise(**settings)


def test_a_copy_goes_its_own_way() -> None:
    walk = process_noise()
    after(walk, report(1.0, 0.0))
    twin = walk.copy()
    after(twin, report(1.1, 1.0))
    assert after(walk, report(1.2, 0.0)) == pytest.approx(math.hypot(STEADY, 0.05))
