"""A lying RSU among three: found, named, isolated, and trusted again; the track stays."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Array, Field, RsuMeasurement, TrackState
from netpos.tracking import Tracker, TrackOutput
from netpos.tracking.health.health import RsuReport, RsuState

T0 = 1_000_000_000
FIELDS = Field.AZIMUTH | Field.TOA | Field.RANGE
START_S, HONEST_S, END_S, STEP_S = 8.0, 20.0, 36.0, 0.1

Lie = Callable[[RsuMeasurement], RsuMeasurement]


def longer(m: RsuMeasurement) -> RsuMeasurement:
    return replace(m, range_m=m.range_m + 30.0)


def turned(m: RsuMeasurement) -> RsuMeasurement:
    return replace(m, azimuth_rad=m.azimuth_rad + math.radians(20.0))


def stepped(m: RsuMeasurement) -> RsuMeasurement:
    return replace(m, toa_s=m.toa_s + 100e-9)


LIES: dict[str, tuple[Lie, Field, str]] = {
    "range": (longer, Field.AZIMUTH | Field.RANGE, r"range late by (29|30)\.\d m"),
    "azimuth": (turned, Field.AZIMUTH | Field.RANGE, r"azimuth off by (19|20)\.\d deg"),
    "clock": (stepped, Field.AZIMUTH | Field.TOA, r"clock step of (9\d|10\d) ns"),
}


def truth(t_s: float) -> Array:
    """Up and down the street between the RSUs at 2 m/s or less, clock gaining 25 ppm."""
    w = 0.1
    return np.array(
        [
            60.0 - 20.0 * math.cos(w * t_s),
            1.0,
            20.0 * w * math.sin(w * t_s),
            0.0,
            500.0 + 7494.8 * t_s,
            7494.8,
        ]
    )


def drive(
    world: Any,
    lie: Lie,
    fields: Field,
    start_s: float,
    honest_s: float,
    seed: int,
    end_s: float,
    **config: Any,
) -> tuple[Tracker, list[tuple[float, TrackOutput]], dict[float, RsuReport]]:
    """Outputs with the errors, and what is said of RSU b second by second."""
    world.rng = np.random.default_rng(seed)
    world.angle_sd, world.range_sd = math.radians(0.8), 0.4
    tracker = world.tracker(**config)
    found, reports = [], {}
    for k in range(round(end_s / STEP_S)):
        t = STEP_S * k
        for m in world.measure(t, truth(t), fields):
            lying = m.rsu_id == "b" and start_s <= t < honest_s
            assert tracker.add(lie(m) if lying else m) is None
        for output in tracker.process():
            error = math.inf
            if output.odometry is not None:
                error = float(np.hypot(*(output.odometry.position[:2] - truth(t)[:2])))
            found.append((error, output))
        if k % 10 == 9:
            by_name = {report.rsu_id: report for report in tracker.rsu_reports()}
            reports[round(t + STEP_S, 1)] = by_name["b"]
            for name in "ac":
                assert by_name[name].state is RsuState.OK, (t, by_name[name].text)
    return tracker, found, reports


@pytest.mark.parametrize("name", LIES)
@pytest.mark.parametrize("seed", range(3))
def test_a_lie_is_found_named_isolated_and_forgiven(world: Any, name: str, seed: int) -> None:
    lie, fields, words = LIES[name]
    _, found, reports = drive(world, lie, fields, START_S, HONEST_S, seed, END_S)
    settled = [error for error, o in found if o.status.stamp_ns > T0 + 2 * 10**9]
    assert max(settled) < 1.0
    assert all(r.state is RsuState.OK for t, r in reports.items() if t <= START_S)
    assert reports[START_S + 5.0].state is not RsuState.OK  # suspected within five seconds
    at_last = reports[HONEST_S]
    assert at_last.state is RsuState.EXCLUDED
    assert at_last.text.startswith("isolated: ")
    assert re.search(words, at_last.text), at_last.text
    assert reports[END_S].state is RsuState.OK, reports[END_S].text
    last = found[-1][1].status
    assert last.sources == ("a", "b", "c")
    assert last.rejected["isolated_rsu"] > 50
    assert "track_lost" not in last.rejected
    assert last.state is TrackState.TRACKING


@pytest.mark.parametrize("filter_name", ["ekf", "ukf", "srukf"])
@pytest.mark.parametrize("name", LIES)
def test_every_filter_leaves_a_liar_out(world: Any, name: str, filter_name: str) -> None:
    """The clock steps while its drift is still unknown: every time of arrival passes alone."""
    lie, fields, words = LIES[name]
    start_s, config = 0.5, {"filter": filter_name, "clock_walk_density": 1e-6}
    _, found, reports = drive(world, lie, fields, start_s, 99.0, 5, 12.0, **config)
    settled = [error for error, o in found if o.status.stamp_ns > T0 + 2 * 10**9]
    assert max(settled) < 1.0
    assert found[-1][1].status.rejected["gate"] > 0
    assert "track_lost" not in found[-1][1].status.rejected
    assert reports[12.0].state is RsuState.EXCLUDED
    assert re.search(words, reports[12.0].text), reports[12.0].text


def moved(m: RsuMeasurement) -> RsuMeasurement:
    return replace(m, position=m.position + np.array([5.0, -5.0, 0.0]))


@pytest.mark.parametrize("filter_name", ["kf", "iekf"])
def test_a_network_whose_fixes_are_off(world: Any, filter_name: str) -> None:
    config = {"filter": filter_name, "accel_density_mps2_sqrthz": 20.0}
    drift = Field.POSITION
    _, found, reports = drive(world, moved, drift, START_S, 99.0, 1, 16.0, **config)
    assert max(error for error, o in found if o.status.stamp_ns > T0 + 2 * 10**9) < 1.5
    assert reports[16.0].state is RsuState.EXCLUDED


@pytest.mark.parametrize("name", ["range", "azimuth", "clock"])
@pytest.mark.parametrize("seed", range(3))
def test_a_lie_from_the_start(world: Any, name: str, seed: int) -> None:
    """The first fix is that of the two others, and the liar is isolated all the same."""
    lie, fields, words = LIES[name]
    _, found, reports = drive(world, lie, fields, -1.0, 99.0, seed, 16.0)
    first_s = next(k for k, (error, _) in enumerate(found) if error < math.inf) * STEP_S
    assert first_s < 3.5
    settled = [error for error, o in found if o.status.stamp_ns > T0 + 6 * 10**9]
    assert max(settled) < 1.0
    assert reports[16.0].state is RsuState.EXCLUDED
    assert re.search(words, reports[16.0].text), reports[16.0].text
    assert "track_lost" not in found[-1][1].status.rejected
