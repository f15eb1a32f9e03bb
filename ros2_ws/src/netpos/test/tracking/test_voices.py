"""Two senders in the name of one RSU: neither counts, the others go on, the name is told."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Array, Field, InitialPose, RsuInfo, RsuMeasurement, TrackState
from netpos.tracking import Tracker, TrackerConfig, TrackOutput
from netpos.tracking.door.voices import Voices, bends

NS = 1_000_000_000
C = 299_792_458.0
SITES = {"a": (0.0, 0.0, 10.0), "b": (120.0, 40.0, 10.0), "c": (50.0, 120.0, 10.0)}
AZIMUTH_SD, TOA_SD = math.radians(2.0), 1.0 / C
AWAY = np.array([21.0, 21.0, 0.0])
PERIOD_NS = NS // 10


def place(stamp_ns: int) -> Array:
    angle = 0.25 * stamp_ns / NS
    return np.array([60.0 + 20.0 * math.cos(angle), 20.0 + 20.0 * math.sin(angle), 0.0])


def measured(
    name: str, stamp_ns: int, at: Array, rng: np.random.Generator, vue_id: str = "v"
) -> RsuMeasurement:
    x, y, z = at - np.array(SITES[name])
    return RsuMeasurement(
        stamp_ns=stamp_ns,
        rsu_id=name,
        vue_id=vue_id,
        expected=len(SITES),
        fields=Field.AZIMUTH | Field.TOA,
        azimuth_rad=math.atan2(y, x) + float(rng.normal(0.0, AZIMUTH_SD)),
        azimuth_var=AZIMUTH_SD**2,
        toa_s=math.sqrt(x * x + y * y + z * z) / C + float(rng.normal(0.0, TOA_SD)),
        toa_var=TOA_SD**2,
    )


def honest(seconds: float, vue_id: str = "v") -> list[RsuMeasurement]:
    rng = np.random.default_rng(3)
    stamps = [NS + k * PERIOD_NS for k in range(round(seconds * 10))]
    return [measured(name, t, place(t), rng, vue_id) for t in stamps for name in SITES]


def false(rate_hz: float, from_s: float, to_s: float) -> Iterator[RsuMeasurement]:
    """In the name of a, of a device 30 m away."""
    rng = np.random.default_rng(4)
    for k in range(round((to_s - from_s) * rate_hz)):
        t = NS + round((from_s + (k + 0.5) / rate_hz) * NS)
        yield measured("a", t, place(t) + AWAY, rng)


def tracked(items: list[RsuMeasurement]) -> tuple[Tracker, list[list[TrackOutput]]]:
    """What the tracker says after each item."""
    tracker = Tracker(TrackerConfig())
    for name, at in SITES.items():
        tracker.add_rsu(RsuInfo(rsu_id=name, position=np.array(at)))
    for vue_id in sorted({m.vue_id for m in items}):
        tracker.add(InitialPose(stamp_ns=NS, vue_id=vue_id, position=place(NS), cov=np.eye(3)))
    said = []
    for item in items:
        tracker.add(item)
        said.append(tracker.process())
    return tracker, said


def mixed(*streams: list[RsuMeasurement]) -> list[RsuMeasurement]:
    return sorted((m for stream in streams for m in stream), key=lambda m: m.stamp_ns)


def errors_m(outputs: list[TrackOutput]) -> Array:
    found = [o.odometry for o in outputs if o.odometry is not None]
    return np.array([np.hypot(*(o.position - place(o.stamp_ns))[:2]) for o in found])


@pytest.mark.parametrize("rate_hz", [20.0, 400.0, 2000.0])
def test_a_flood_of_false_values_in_a_known_name_moves_nothing(rate_hz: float) -> None:
    lies = list(false(rate_hz, 5.0, 9.0))
    tracker, said = tracked(mixed(honest(12.0), lies))
    outputs = [o for told in said for o in told]
    assert errors_m(outputs).max() < 3.0  # sds of 1 m and of 2 degrees at 60 m, three RSUs
    for o in outputs:
        if o.odometry is not None and o.status.state is TrackState.TRACKING:
            assert errors_m([o])[0] <= o.status.protection_level_m
    counts = tracker.refusals.rsus()["a"].counts
    assert sum(counts.values()) > 0.95 * len(lies)
    assert "does somebody else send in its name?" in tracker.refusals.rsus()["a"].sentence


def test_epochs_do_not_wait_for_an_rsu_that_is_not_heard() -> None:
    """Others announce three measurements; with two of them the epoch is complete."""
    items = mixed(honest(9.0), list(false(100.0, 5.0, 9.0)))
    _, said = tracked(items)
    newest = [(item, told) for item, told in zip(items, said, strict=True) if item.rsu_id == "c"]
    waited = [m for m, told in newest if m.stamp_ns not in {o.status.stamp_ns for o in told}]
    assert len(waited) <= 2  # until the first contradiction


def test_the_rsu_is_heard_again_a_second_after_the_other_sender_has_gone() -> None:
    tracker, said = tracked(mixed(honest(14.0), list(false(100.0, 5.0, 7.0))))
    used = [o.status.stamp_ns for told in said for o in told if "a" in o.status.sources]
    silent = [t for t in used if NS + 5.2 * NS < t < NS + 7.9 * NS]
    assert silent == []
    assert len([t for t in used if t >= NS + 8.2 * NS]) > 50
    assert tracker.refusals.rsus()["a"].words() == ""


def test_another_device_keeps_the_rsu() -> None:
    items = mixed(honest(9.0), honest(9.0, "w"), list(false(400.0, 5.0, 9.0)))
    tracker, _ = tracked(items)
    assert tracker.rejected()["w"].total() == 0
    assert tracker.rejected()["v"]["conflict"] > 1000


def test_an_rsu_that_sends_more_often_is_heard() -> None:
    """Five times as often, and every value fits the others."""
    rng = np.random.default_rng(5)
    fast = [NS + 5 * NS + k * PERIOD_NS // 5 for k in range(200)]
    items = [*honest(5.0), *(measured("a", t, place(t), rng) for t in fast)]
    tracker, _ = tracked(items)
    assert tracker.rejected()["v"]["conflict"] == 0


def test_outliers_at_the_usual_pace_are_no_second_sender() -> None:
    items = [
        replace(m, toa_s=m.toa_s + 1e-6) if k % 7 == 0 else m for k, m in enumerate(honest(12.0))
    ]
    tracker, _ = tracked(items)
    assert tracker.rejected()["v"]["conflict"] == 0


def line(offset_m: float, late: float = 0.5) -> tuple[RsuMeasurement, ...]:
    """Three ranges of a device that moves evenly, in 20 ms; the second is ``offset_m`` off."""
    stamps = (NS, NS + round(late * 20_000_000), NS + 20_000_000)
    ranges = (10.0, 10.0 + 0.4 * late + offset_m, 10.4)
    one = RsuMeasurement(stamp_ns=0, rsu_id="a", vue_id="v", fields=Field.RANGE, range_var=0.01)
    return tuple(replace(one, stamp_ns=t, range_m=r) for t, r in zip(stamps, ranges, strict=True))


@pytest.mark.parametrize("late", [0.5, 0.1])
def test_a_bend_begins_at_five_sd_and_a_hard_manoeuvre(late: float) -> None:
    sd = 0.1 * math.sqrt(1.0 + late**2 + (1.0 - late) ** 2)
    braking_m = 0.5 * 20.0 * 0.02**2 * late * (1.0 - late)
    limit_m = 5.0 * sd + braking_m
    assert not bends(*line(limit_m - 1e-3, late))
    assert bends(*line(limit_m + 1e-3, late))
    assert bends(*line(-limit_m - 1e-3, late))


def test_what_cannot_be_compared_bends_nothing() -> None:
    first, middle, last = line(5.0)
    assert bends(first, middle, last)
    other = replace(middle, fields=Field.TOA, toa_s=1.0, toa_var=1e-18)
    assert not bends(first, other, last)
    assert not bends(first, replace(middle, reference_rsu_id="b"), last)


def test_a_direction_across_the_back_does_not_bend() -> None:
    one = RsuMeasurement(
        stamp_ns=0, rsu_id="a", vue_id="v", fields=Field.AZIMUTH, azimuth_var=1e-4
    )
    angles = (math.pi - 0.01, -math.pi + 0.01, -math.pi + 0.03)
    three = [
        replace(one, stamp_ns=NS + k * NS // 100, azimuth_rad=a) for k, a in enumerate(angles)
    ]
    assert not bends(*three)
    assert bends(three[0], replace(three[1], azimuth_rad=0.0), three[2])


def test_a_position_is_compared_axis_by_axis() -> None:
    one = RsuMeasurement(
        stamp_ns=0,
        rsu_id="a",
        vue_id="v",
        fields=Field.POSITION,
        position_cov=np.diag([0.01, 0.01, 1.0]),
    )

    def at(k: int, y: float) -> RsuMeasurement:
        return replace(one, stamp_ns=NS + k * NS // 100, position=np.array([5.0, y, 0.0]))

    assert not bends(at(0, 1.0), at(1, 1.5), at(2, 1.0))
    assert bends(at(0, 1.0), at(1, 2.0), at(2, 1.0))


def test_a_device_whose_time_was_set_back_is_compared_with_nothing_old() -> None:
    def feed(voices: Voices, items: list[RsuMeasurement]) -> list[Any]:
        found = []
        for m in items:
            found.append(voices.contradicts(m))
            if not found[-1]:
                voices.take(m)
        return found

    voices, items = Voices(), [m for m in honest(6.0) if m.rsu_id == "a"]
    assert not any(feed(voices, items))
    near = replace(items[-1], stamp_ns=items[-1].stamp_ns + 1_000_000, toa_s=1e-6)
    assert voices.contradicts(near)
    assert voices.silenced("v", near.stamp_ns) == 1
    assert voices.refuses("a", "v", near.stamp_ns + NS // 2)
    assert not voices.refuses("a", "w", near.stamp_ns + NS // 2)
    voices.forget("v")
    assert voices.silenced("v", near.stamp_ns) == 0
    assert not voices.refuses("a", "v", near.stamp_ns + NS // 2)
    assert not voices.contradicts(near)
