"""Bad input to dead reckoning: one sentence each, degraded but honest output, never a NaN."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from netpos.inertial.gait import GaitModel
from netpos.inertial.gait import walk as walk_route
from netpos.inertial.imu import ImuModel, MagnetometerModel, simulate_imu, simulate_magnetometer
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_config import PdrConfig
from netpos.inertial.pdr_output import StepVelocity
from netpos.inertial.watch import Conditions

G = 9.80665
NS = 1_000_000_000
Sample = tuple[int, np.ndarray, np.ndarray, np.ndarray | None]


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    """Rest, 12 m of walking at the waist, rest; field samples with every IMU sample."""
    gait = walk_route([[0, 0], [12, 0]], GaitModel(), pauses_s=[3.0, 2.0])
    imu = simulate_imu(ImuModel(), gait, NS, 5, "v")
    field = simulate_magnetometer(
        MagnetometerModel(rate_hz=100.0, declination_deg=0.0), gait, NS, 5, "v"
    )[1]
    return list(
        zip(
            imu.stamp_ns.tolist(), imu.angular_velocity, imu.specific_force, field[1:], strict=True
        )
    )


def run(
    samples: list[Sample], **config: Any
) -> tuple[PedestrianDeadReckoning, list[str], list[StepVelocity], int]:
    core = PedestrianDeadReckoning(PdrConfig.from_mapping({"placement": "waist", **config}))
    velocities, steps = [], 0
    for stamp, rate, force, field in samples:
        out = core.add_imu(stamp, rate, force)
        if field is not None:
            core.add_magnetic_field(stamp, field)
        if out is not None:
            steps += len(out.steps)
            velocities += [out.velocity] if out.velocity else []
    for v in velocities:
        assert np.isfinite(v.velocity).all()
        assert np.linalg.eigvalsh(v.covariance)[0] > 0
    return core, core.take_notices(), velocities, steps


def mapped(samples: list[Sample], change: Callable[[np.ndarray], np.ndarray]) -> list[Sample]:
    """Axes changed alike for all three sensors."""
    return [(t, change(w), change(f), None if m is None else change(m)) for t, w, f, m in samples]


def test_a_good_stream_has_nothing_to_tell(samples: list[Sample]) -> None:
    core, notices, _, steps = run(samples)
    assert notices == []
    assert core.conditions == ()
    assert steps == 19


def test_without_a_magnetometer_the_heading_is_the_gyros_and_its_variance_grows(
    samples: list[Sample],
) -> None:
    bare = [(t, w, f, None) for t, w, f, _ in samples]
    core, notices, velocities, steps = run(bare)
    assert steps == 19
    assert core.conditions == ("no_magnetic_field",)
    assert len(notices) == 1
    assert "no magnetic field is heard: the heading comes from the gyro alone" in notices[0]
    assert "0.001 rad/s" in notices[0]
    assert {v.heading_reference for v in velocities} == {"relative"}
    walking = [v for v in velocities if np.any(v.velocity)]
    assert abs(math.atan2(*walking[-1].velocity[::-1])) < 0.1


def test_a_magnetometer_that_falls_silent_and_comes_back_is_reported_both_ways(
    samples: list[Sample],
) -> None:
    silent = [(t, w, f, None if 6 * NS < t < 12 * NS else m) for t, w, f, m in samples]
    core, notices, _, _ = run(silent)
    assert [n.split(":")[0] for n in notices] == [
        "no magnetic field is heard",
        "the magnetic field gives the heading again",
    ]
    assert core.conditions == ()


def test_a_lasting_disturbance_is_reported(samples: list[Sample]) -> None:
    bent = [(t, w, f, m * (1.0 if t < 6 * NS else 2.0)) for t, w, f, m in samples]
    core, notices, _, _ = run(bent)
    assert "the magnetic field is disturbed" in notices[0]
    assert core.counters["magnetic_disturbed"] > 300


@pytest.mark.parametrize("every", [5, 10])
def test_a_wrong_rate_makes_the_velocity_unknown(samples: list[Sample], every: int) -> None:
    """20 and 10 Hz: below the 25 Hz that steps need."""
    core, notices, velocities, _ = run(samples[::every], max_gap_s=0.25)
    assert core.conditions == ("rate",)
    assert f"the IMU comes at {100 / every:.1f} Hz, outside 25 to 2000 Hz" in notices[0]
    assert len(notices) == 1
    for v in velocities[15:]:
        np.testing.assert_array_equal(v.velocity, 0.0)
        np.testing.assert_allclose(v.covariance, np.eye(2))


def test_a_rate_that_recovers_is_reported(samples: list[Sample]) -> None:
    slow = [s for i, s in enumerate(samples) if i > 600 or i % 5 == 0]
    core, notices, _, steps = run(slow)
    assert [n[:19] for n in notices] == ["the IMU comes at 20", "the IMU comes at 10"]
    assert core.conditions == ()
    assert steps > 12


def test_gaps_are_reported_once_and_counted(samples: list[Sample]) -> None:
    holes = [s for s in samples if not (5 * NS < s[0] < 5.5 * NS or 9 * NS < s[0] < 9.4 * NS)]
    core, notices, velocities, steps = run(holes)
    assert core.counters["gap"] == 2
    assert len(notices) == 1
    assert "a gap of 0.50 s in the IMU stream" in notices[0]
    assert steps >= 14
    assert max(np.linalg.norm(v.velocity) for v in velocities) < 2.0


SWAPS = [p for p in itertools.permutations(range(3)) if p[2] != 2]


@pytest.mark.parametrize("order", SWAPS)
def test_swapped_axes_show_by_gravity_and_the_heading_is_not_believed(
    samples: list[Sample], order: tuple[int, int, int]
) -> None:
    core, notices, velocities, steps = run(mapped(samples, lambda v: v[list(order)]))
    assert core.conditions == ("axes",)
    assert f"gravity points along +{'xyz'[order.index(2)]} of the device" in notices[0]
    assert "its axes are swapped" in notices[0]
    assert len(notices) == 1
    assert steps == 19  # the count needs no axes
    for v in velocities[15:]:
        np.testing.assert_array_equal(v.velocity, 0.0)


def test_a_device_worn_upside_down_is_reported(samples: list[Sample]) -> None:
    core, notices, _, _ = run(mapped(samples, lambda v: v * [1.0, -1.0, -1.0]))
    assert core.conditions == ("axes",)
    assert "gravity points along -z of the device, 1" in notices[0]


@pytest.mark.parametrize(("tilt_deg", "noticed"), [(57.0, False), (63.0, True)])
def test_mount_tilt_at_its_boundary(tilt_deg: float, noticed: bool) -> None:
    tilt = math.radians(tilt_deg)
    force = np.array([G * math.sin(tilt), 0.0, G * math.cos(tilt)])
    still = [(NS + i * NS // 100, np.zeros(3), force, None) for i in range(1000)]
    core, _, _, _ = run(still)
    assert ("axes" in core.conditions) is noticed


def test_carried_devices_may_be_held_anyhow(samples: list[Sample]) -> None:
    core, notices, _, _ = run(mapped(samples, lambda v: v[[2, 0, 1]]), placement="carried")
    assert "axes" not in core.conditions
    assert notices == []


def test_a_saturated_accelerometer_is_reported_once_and_steps_are_still_counted(
    samples: list[Sample],
) -> None:
    declared = [(t, w, np.clip(f, -11.0, 11.0), m) for t, w, f, m in samples]
    core, notices, _, steps = run(declared, accelerometer_range_mps2=11.0)
    assert core.counters["accelerometer_saturated"] > 30
    assert len(notices) == 1
    assert "accelerometer_range_mps2 11" in notices[0]
    assert 15 <= steps <= 21


def test_a_plateau_of_the_largest_reading_is_taken_for_saturation() -> None:
    """16 m/s^2 again and again, but 156 declared; the same value once in a while is none."""

    def stream(held: int) -> Iterator[Sample]:
        rng = np.random.default_rng(1)
        for i in range(600):
            force = np.array([0.0, 0.0, G]) + rng.normal(scale=0.1, size=3)
            if i % 60 >= 60 - held:
                force[2] = 16.0
            yield NS + i * NS // 100, rng.normal(scale=0.01, size=3), force, None

    core, notices, _, _ = run(list(stream(6)))
    assert core.counters["accelerometer_saturated"] == 3 * 10
    assert "16.0 m/s^2, read again and again" in notices[0]
    core, notices, _, _ = run(list(stream(3)))
    assert core.counters.get("accelerometer_saturated", 0) == 0


def test_a_saturated_gyro_is_reported(samples: list[Sample]) -> None:
    """The heading is kept, less surely, until the field gives it again."""
    cut = [(t, np.clip(w, -0.15, 0.15), f, None) for t, w, f, _ in samples]
    core, notices, velocities, steps = run(cut, gyro_range_radps=0.15)
    assert core.counters["gyro_saturated"] > 50
    assert "gyro_range_radps 0.15" in notices[0]
    assert steps == 19
    sure = run([(t, w, f, None) for t, w, f, _ in samples])[2]
    late = [v.stamp_ns > 12 * NS and bool(np.any(v.velocity)) for v in sure]
    across = [
        [v.covariance[1, 1] for v, ok in zip(vs, late, strict=True) if ok]
        for vs in (velocities, sure)
    ]
    assert np.median(across[0]) > 1.05 * np.median(across[1])


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_samples_that_are_not_finite_are_left_out_and_reported_once(
    samples: list[Sample], bad: float
) -> None:
    broken = [
        (t, w, f if i % 50 else np.array([0.0, bad, G]), m)
        for i, (t, w, f, m) in enumerate(samples)
    ]
    core, notices, _, steps = run(broken)
    assert core.counters["not_finite"] == len(samples[::50])
    assert len(notices) == 1
    assert "not_finite" in notices[0]
    assert steps == 19


def test_force_in_g_is_reported_until_it_is_plausible(samples: list[Sample]) -> None:
    wrong = [(t, w, f / (G if t < 3 * NS else 1.0), m) for t, w, f, m in samples]
    core, notices, _, steps = run(wrong)
    assert "the mean specific force is not 9.8 m/s^2: is it in g" in notices[0]
    assert "plausible now" in notices[1]
    assert core.conditions == ()
    assert steps > 15


def test_conditions_are_reported_when_they_begin_and_end() -> None:
    c = Conditions()
    for holds in (False, True, True, False, False, True):
        c.set("name", holds, "begins", "ends")
    assert c.take() == ["begins", "ends", "begins"]
    assert c.take() == []
    assert c.active == ("name",)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"placement": "ankle"}, "placement must be carried or waist"),
        ({"height": 1.8}, "no parameter height of pdr; did you mean height_m\\?"),
        ({"steps.bounce": 1}, "no parameter steps.bounce"),
        ({"height_m": "tall"}, "pdr.height_m must be of type float, got 'tall'"),
        ({"steps.bout_steps": 2.5}, "pdr.steps.bout_steps must be of type int, got 2.5"),
        ({"hard_iron_t": [1e-6, 0.0]}, "pdr.hard_iron_t must be 3 finite numbers"),
        ({"hard_iron_t": [1e-6, math.nan, 0.0]}, "pdr.hard_iron_t must be 3 finite numbers"),
        ({"field_matrix": "none"}, "pdr.field_matrix must be of type tuple, got 'none'"),
        ({"height_m": True}, "pdr.height_m must be of type float, got True"),
        (
            {"attitude.heading_gain_per_s": -1.0},
            r"attitude.heading_gain_per_s must be in \[0, 1e\+09\], got -1.0",
        ),
    ],
)
def test_bad_mapping_is_one_clear_error(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PdrConfig.from_mapping(values)


def test_mapping_and_flat_are_inverse() -> None:
    config = PdrConfig.from_mapping(
        {"placement": "waist", "height_m": 2, "steps.bout_steps": 4, "attitude.field_memory_s": 9}
    )
    assert (config.height_m, config.steps.bout_steps) == (2.0, 4)
    assert config.attitude.field_memory_s == 9.0
    assert config.steps.signal == "impact"
    assert PdrConfig.from_mapping(config.flat()) == config
