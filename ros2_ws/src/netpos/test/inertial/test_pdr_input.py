"""What dead reckoning does with bad samples, stamps, gaps, late fields and settings."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_config import PdrConfig
from netpos.inertial.steps import StepConfig
from netpos.messages.fields import stamp_ns
from straight_walk import G, Walk, heading_error, run, walk


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        ("rate", math.nan, "not_finite"),
        ("force", math.inf, "not_finite"),
        ("force", 157.0, "accelerometer_saturated"),
        ("rate", -35.0, "gyro_saturated"),
    ],
)
def test_a_bad_sample_is_counted_and_changes_nothing(
    column: str, value: float, reason: str
) -> None:
    w = walk()
    bad = Walk(w.stamps, w.rate.copy(), w.force.copy(), w.field)
    rows = range(400, 2000, 400)
    for row in rows:
        getattr(bad, column)[row, 1] = value
    core, events, velocities = run(bad)
    assert core.counters == {reason: len(rows)}
    assert len(events) == len(run(w)[1])
    for v in velocities:
        assert np.all(np.isfinite(v.velocity))
        assert np.all(np.isfinite(v.covariance))


@pytest.mark.parametrize(
    ("range_mps2", "counted"), [(30.0, True), (30.001, False)]
)  # the sample has 30 m/s^2
def test_saturation_at_its_boundary(range_mps2: float, counted: bool) -> None:
    core = PedestrianDeadReckoning(PdrConfig(accelerometer_range_mps2=range_mps2))
    core.add_imu(0, (0, 0, 0), (0, 0, -30.0))
    assert core.counters.get("accelerometer_saturated", 0) == int(counted)


def test_malformed_vectors_are_counted() -> None:
    core = PedestrianDeadReckoning()
    assert core.add_imu(0, (0.0, 0.0), (0.0, 0.0, G)) is None
    core.add_magnetic_field(0, (1e-5, 1e-5))
    assert core.counters == {"malformed": 1, "magnetic_malformed": 1}


def test_stamps_duplicated_or_backwards_are_refused() -> None:
    core = PedestrianDeadReckoning()
    for stamp in (0, 10_000_000, 10_000_000, 5_000_000, 20_000_000):
        core.add_imu(stamp, (0, 0, 0), (0, 0, G))
    assert core.counters == {"stamp_duplicate": 1, "stamp_backwards": 1}


@pytest.mark.parametrize(("back_ns", "reset"), [(999_999_999, False), (1_000_000_000, True)])
def test_a_clock_set_back_restarts_at_its_boundary(back_ns: int, reset: bool) -> None:
    core = PedestrianDeadReckoning(PdrConfig(clock_reset_s=1.0))
    for i in range(200):
        core.add_imu(i * 10**7, (0, 0, 0), (0, 0, G))
    assert core.attitude.aligned
    core.add_imu(199 * 10**7 - back_ns, (0, 0, 0), (0, 0, G))
    assert core.counters == ({"clock_reset": 1} if reset else {"stamp_backwards": 1})
    assert core.attitude.aligned is not reset


@pytest.mark.parametrize(("gap_s", "gaps"), [(0.25, 0), (0.26, 1)])
def test_gap_at_its_boundary(gap_s: float, gaps: int) -> None:
    core = PedestrianDeadReckoning(PdrConfig(max_gap_s=0.25))
    core.add_imu(0, (0, 0, 0), (0, 0, G))
    core.add_imu(round(gap_s * 1e9), (0, 0, 0), (0, 0, G))
    assert core.counters.get("gap", 0) == gaps


def test_after_a_gap_the_heading_is_kept_with_a_larger_sd() -> None:
    w = walk(turn_deg=90.0)
    keep = (w.stamps < 10**18 + 15 * 10**9) | (w.stamps >= 10**18 + 16 * 10**9)
    cut = Walk(w.stamps[keep], w.rate[keep], w.force[keep], w.field[keep])
    core, events, _ = run(cut, PdrConfig(heading_drift_radps=0.0, gap_rate_sd_radps=0.5))
    assert core.counters["gap"] == 1
    late = [e for e in events if e.start_ns > 10**18 + 17 * 10**9]
    assert max(heading_error(e, 90.0) for e in late) < 0.06
    assert late[-1].heading_sd_rad == pytest.approx(math.hypot(0.1, 0.5 * 1.01), rel=0.02)
    _, fixed, _ = run(cut, magnetic=True)
    assert fixed[-1].heading_sd_rad == pytest.approx(0.1, rel=0.03)


def test_no_burst_of_ticks_after_a_gap() -> None:
    w = walk()
    keep = (w.stamps < 10**18 + 10 * 10**9) | (w.stamps >= 10**18 + 14 * 10**9)
    cut = Walk(w.stamps[keep], w.rate[keep], w.force[keep], w.field[keep])
    _, _, velocities = run(cut, PdrConfig(output_rate_hz=10.0))
    assert np.min(np.diff([v.stamp_ns for v in velocities])) >= 80_000_000


def test_a_late_magnetometer_never_mixes_the_frames() -> None:
    w, heading_deg, on_ns = walk(120.0), 120.0, 10**18 + 12 * 10**9
    core, headings = PedestrianDeadReckoning(), []
    for i, stamp in enumerate(w.stamps.tolist()):
        out = core.add_imu(stamp, w.rate[i], w.force[i])
        if stamp >= on_ns:
            core.add_magnetic_field(stamp, w.field[i])
        if out is None:
            continue
        for e in out.steps:
            expected = heading_deg if e.heading_reference == "map" else 0.0
            assert heading_error(e, expected) < 0.04
        if out.velocity is not None and np.any(out.velocity.velocity):
            v = out.velocity
            expected = heading_deg if v.heading_reference == "map" else 0.0
            seen = math.atan2(v.velocity[1], v.velocity[0])
            assert abs(seen - math.radians(expected)) < 0.04
            headings.append(v.heading_reference)
    assert set(headings) == {"map", "relative"}


def test_wrong_rate_is_counted_and_undecided() -> None:
    core = PedestrianDeadReckoning(PdrConfig(min_rate_hz=25.0))
    velocities = []
    for i in range(100):
        out = core.add_imu(i * 10**8, (0, 0, 0), (0, 0, G))  # 10 Hz, at rest
        velocities += [out.velocity] if out and out.velocity else []
    assert core.counters["rate_out_of_range"] >= 8
    assert velocities[-1].moving


def test_force_in_g_is_reported_and_never_aligns() -> None:
    core = PedestrianDeadReckoning()
    outs = [core.add_imu(i * 10**7, (0, 0, 0), (0, 0, 1.0)) for i in range(300)]
    assert not any(outs)
    assert core.counters["gravity_implausible"] == pytest.approx(5, abs=1)


def test_field_in_microtesla_is_counted_and_ignored() -> None:
    w = walk()
    micro = Walk(w.stamps, w.rate, w.force, w.field * 1e6)
    core, events, _ = run(micro, magnetic=True)
    assert core.counters == {"magnetic_out_of_range": len(w.stamps)}
    assert events[-1].heading_reference == "relative"


def test_nothing_after_rest_depends_on_the_epoch() -> None:
    """Integer stamps: the same walk two decades apart gives the same numbers."""
    a, b = run(walk(start_ns=0))[1], run(walk(start_ns=17 * 10**17))[1]
    assert [e.end_ns for e in a] == [e.end_ns - 17 * 10**17 for e in b]
    assert [e.length_m for e in a] == [e.length_m for e in b]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_input_raises_or_gives_nan(seed: int) -> None:
    rng = np.random.default_rng(seed)
    core, stamp = PedestrianDeadReckoning(PdrConfig(output_rate_hz=50.0)), 0
    special = [math.nan, math.inf, -math.inf, 0.0, 1e-300, 1e300, 200.0]
    for _ in range(300):
        stamp += int(rng.choice([-2 * 10**9, -5, 0, 10**7, 10**7, 10**7, 10**9], p=None))
        rate, force, field = rng.normal(0, 3, 3), rng.normal(0, 10, 3), rng.normal(0, 5e-5, 3)
        if rng.random() < 0.1:
            [rate, force, field][rng.integers(3)][rng.integers(3)] = rng.choice(special)
        core.add_magnetic_field(stamp, field)
        out = core.add_imu(stamp, rate, force)
        if out is not None and out.velocity is not None:
            assert np.all(np.isfinite(out.velocity.velocity))
            assert np.all(np.linalg.eigvalsh(out.velocity.covariance) > 0)


@pytest.mark.parametrize(
    "bad",
    [
        {"output_rate_hz": 0.0},
        {"weinberg_k": -0.4},
        {"heading_drift_radps": -1e-9},
        {"mount_heading_rad": 90.0},
        {"max_gap_s": 0.01},
        {"max_rate_hz": 20.0},
        {"still_speed_sd_mps": math.nan},
    ],
)
def test_bad_config_names_the_value(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        PdrConfig(**bad)


def test_nested_config_reaches_the_detector() -> None:
    w = walk(walk_s=2.2)  # four steps
    assert len(run(w, PdrConfig(steps=StepConfig(bout_steps=9)))[1]) == 0
    assert len(run(w, PdrConfig(steps=StepConfig(bout_steps=2)))[1]) >= 4


@pytest.mark.parametrize("late_ns", [0, 40_000_000, 90_000_000])
def test_the_order_of_arrival_of_imu_and_field_does_not_matter(late_ns: int) -> None:
    """Field samples less than ``field_hold_s`` late give the same output to the last bit."""
    w = walk(40.0, turn_deg=60.0)

    def through(field_first: bool) -> list[tuple[float, ...]]:
        core, out, waiting = PedestrianDeadReckoning(), [], []
        for i, stamp in enumerate(w.stamps.tolist()):
            waiting.append((stamp, w.field[i]))
            while waiting and field_first:
                core.add_magnetic_field(*waiting.pop(0))
            got = core.add_imu(stamp, w.rate[i], w.force[i])
            while waiting and waiting[0][0] + late_ns <= stamp:
                core.add_magnetic_field(*waiting.pop(0))
            if got is not None and got.velocity is not None:
                out.append((got.velocity.stamp_ns, *got.velocity.velocity))
        return out

    expected, got = through(True), through(False)
    assert expected[50:] == got[50:]
    assert len(got) > 200


def test_a_time_that_is_none_is_counted_and_changes_nothing() -> None:
    pdr = PedestrianDeadReckoning()
    bad = stamp_ns(SimpleNamespace(sec=1, nanosec=4 * 10**9))
    for _ in range(3):
        assert pdr.add_imu(bad, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)) is None
    pdr.add_magnetic_field(bad, (2e-5, 0.0, 0.0))
    assert pdr.counters["bad_stamp"] == 3
    assert pdr.counters["magnetic_bad_stamp"] == 1
    assert pdr.take_notices() == [
        "bad_stamp: header.stamp.nanosec is 4000000000; send one below 1000000000"
    ]
    pdr.add_imu(10**9, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
    assert "clock_reset" not in pdr.counters
