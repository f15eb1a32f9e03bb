"""An RSU that sends more than it can measure is limited; nobody else loses anything."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.door.rate_limit import RateLimit

NS = 1_000_000_000
PLACES = {"a": (0.0, 0.0), "b": (60.0, 0.0), "c": (30.0, 50.0)}


def sent(limit: RateLimit, stamps: list[int], vue_id: str = "v") -> list[bool]:
    """Which of these measurements are within the limits, those counted."""
    within = []
    for stamp in stamps:
        within.append(not limit.exceeded("a", vue_id, stamp))
        if within[-1]:
            limit.count("a", vue_id, stamp)
            limit.took("a", vue_id, stamp)
    return within


def test_the_limit_is_met_exactly_and_ends_with_its_second() -> None:
    limit = RateLimit(3, 100)
    assert sent(limit, [NS] * 5) == [True, True, True, False, False]
    assert sent(limit, [2 * NS - 1, 2 * NS]) == [False, True]


def test_stamps_closer_than_half_a_period_are_one_too_many() -> None:
    """Of 10 Hz: 50 ms; the same stamp is another pair of the same instant."""
    limit, half = RateLimit(10, 1000), NS // 20
    stamps = [NS, NS + 1, NS - 1, NS + half - 1, NS + half, NS - half, NS - half + 1, NS]
    assert sent(limit, stamps) == [True, False, False, False, True, True, False, True]


def test_what_is_refused_for_another_reason_keeps_nobody_away() -> None:
    limit = RateLimit(10, 1000)
    limit.count("a", "v", NS)
    assert not limit.exceeded("a", "v", NS + 1)


def test_a_device_that_starts_anew_is_not_held_to_its_old_stamps() -> None:
    limit = RateLimit(10, 1000)
    limit.took("a", "v", NS)
    limit.took("a", "w", NS)
    assert limit.exceeded("a", "v", NS + 1)
    limit.forget("v")
    assert not limit.exceeded("a", "v", NS + 1)
    assert limit.exceeded("a", "w", NS + 1)


def test_all_devices_together_have_a_limit_too() -> None:
    limit = RateLimit(3, 5)
    within = [sent(limit, [NS], f"v{k % 3}")[0] for k in range(8)]
    assert within == [True] * 5 + [False] * 3


def test_rsus_have_limits_of_their_own() -> None:
    limit = RateLimit(1, 1)
    assert sent(limit, [NS, NS]) == [True, False]
    assert not limit.exceeded("b", "v", NS)


def test_a_second_that_comes_late_counts_where_it_belongs() -> None:
    limit = RateLimit(2, 100)
    assert sent(limit, [NS, NS, 2 * NS, NS]) == [True, True, True, False]


def test_time_that_was_set_back_is_no_flood() -> None:
    limit = RateLimit(2, 100)
    assert all(sent(limit, [k * NS for k in (100, 101, 102, 103, 104, 105)]))
    assert all(sent(limit, [k * NS for k in (1, 2, 3, 4, 5, 6)]))


@pytest.mark.parametrize("count", [10_000])
def test_invented_names_take_no_memory_without_end(count: int) -> None:
    limit = RateLimit(10, 10)
    for k in range(count):
        limit.count(f"rsu_{k}", "v", NS)
    assert len(limit._counts) <= 1000


def honest() -> list[RsuMeasurement]:
    """Three RSUs range to a device that stands at (20, 10), ten times a second for 5 s."""
    place = np.array([20.0, 10.0])
    rng = np.random.default_rng(4)
    return [
        RsuMeasurement(
            stamp_ns=NS + k * NS // 10,
            rsu_id=name,
            vue_id="v",
            expected=3,
            fields=Field.RANGE,
            range_m=float(np.linalg.norm(place - xy) + rng.normal(0.0, 0.1)),
            range_var=0.01,
        )
        for k in range(50)
        for name, xy in PLACES.items()
    ]


def tracked(items: list[RsuMeasurement], **parameters: Any) -> tuple[Tracker, list[Any]]:
    tracker = Tracker(TrackerConfig(**parameters))
    for name, (x, y) in PLACES.items():
        tracker.add_rsu(RsuInfo(rsu_id=name, position=np.array([x, y, 0.0])))
    outputs = []
    for item in items:
        tracker.add(item)
        outputs += tracker.process()
    return tracker, outputs + tracker.flush()


def test_a_flood_changes_no_bit_of_the_estimates_and_is_named() -> None:
    clean = honest()
    flood = [replace(m, rsu_id="flooder", sequence=k) for m in clean for k in range(100)]
    mixed = [item for k, m in enumerate(clean) for item in (m, *flood[100 * k : 100 * k + 100])]
    _, expected = tracked(clean)
    tracker, outputs = tracked(mixed, max_rate_hz=20)
    ours = [o.odometry for o in outputs if o.odometry is not None]
    theirs = [o.odometry for o in expected if o.odometry is not None]
    assert len(ours) == len(theirs) > 40
    for a, b in zip(ours, theirs, strict=True):
        assert a.position.tobytes() == b.position.tobytes()
        assert a.pose_cov.tobytes() == b.pose_cov.tobytes()
    refused = tracker.refusals.rsus()["flooder"]
    # 3 honest messages in each of 50 epochs bring 100 more; 20 of each second are heard.
    assert refused.counts["rate"] == 15_000 - 5 * 20
    assert tracker.rejected()["v"]["rate"] == refused.counts["rate"]
    assert "max_rate_hz" in refused.words()
    finding = next(f for f in tracker.findings({}, {}) if f.subject == "rsu flooder")
    assert finding.level.name == "ERROR"


def test_what_floods_need_not_be_added() -> None:
    """The node asks before it reads the message; the count is the same."""
    first = honest()[0]
    asked, added = (Tracker(TrackerConfig(max_rate_hz=5)) for _ in range(2))
    for _ in range(20):
        added.add(first)
        if not asked.floods(first.rsu_id, first.vue_id, first.stamp_ns):
            asked.add(first)
    for tracker in (asked, added):
        assert tracker.refusals.rsus()["a"].counts["rate"] == 15
