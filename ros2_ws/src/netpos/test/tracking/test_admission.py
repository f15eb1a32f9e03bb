"""Which devices are tracked: names cost nothing to invent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from netpos.messages.values import Field, RsuMeasurement
from netpos.tracking import Tracker, TrackerConfig
from street_run import truth

QUANTITIES = Field.AZIMUTH | Field.TOA


def heard(world: Any, vue_id: str, t_s: float) -> list[RsuMeasurement]:
    return [replace(m, vue_id=vue_id) for m in world.measure(t_s, truth(t_s), QUANTITIES, "abc")]


def unsound(world: Any, vue_id: str, t_s: float = 0.0) -> RsuMeasurement:
    return replace(heard(world, vue_id, t_s)[0], toa_var=0.0)


def tracker_of(world: Any, **config: Any) -> Tracker:
    tracker = Tracker(TrackerConfig(**config))
    for info in world.rsus.values():
        tracker.add_rsu(info)
    return tracker


def run(world: Any, tracker: Tracker, vue_id: str, from_s: float, n: int) -> list[str | None]:
    reasons = [tracker.add(m) for k in range(n) for m in heard(world, vue_id, from_s + 0.1 * k)]
    tracker.process()
    return reasons


def test_there_is_room_for_so_many(world: Any) -> None:
    tracker = tracker_of(world, max_devices=2)
    assert run(world, tracker, "one", 0.0, 3) == [None] * 9
    assert run(world, tracker, "two", 0.0, 3) == [None] * 9
    assert run(world, tracker, "three", 0.3, 3) == ["too_many_devices"] * 9
    assert set(tracker.rejected()) == {"one", "two"}
    (line,) = [f for f in tracker.findings({}, {}) if f.subject == "rsus"]
    assert (
        "9 messages of devices not admitted (too_many_devices; the last: 'three')" in line.message
    )
    assert "max_devices is 2; raise it" in line.message


def test_invented_names_do_not_keep_an_honest_device_out(world: Any) -> None:
    """Of 5000 names nothing sound has come: the first sound one takes the place of one of them."""
    tracker = tracker_of(world, max_devices=50)
    for k in range(5000):
        tracker.add(unsound(world, f"made_up_{k}"))
    assert len(tracker.rejected()) == 50
    assert run(world, tracker, "honest", 0.0, 3) == [None] * 9
    assert "honest" in tracker.rejected()
    assert len(tracker.rejected()) == 50
    assert tracker.take_left() == ["made_up_0"]
    assert tracker.take_left() == []


def test_a_silent_device_makes_room_after_the_time_that_ends_its_track(world: Any) -> None:
    tracker = tracker_of(world, max_devices=2, max_gap_s=5.0)
    run(world, tracker, "gone", 0.0, 3)
    run(world, tracker, "stays", 0.0, 70)
    assert run(world, tracker, "early", 4.0, 1) == ["too_many_devices"] * 3
    assert run(world, tracker, "late", 6.9, 1) == [None] * 3
    assert tracker.take_left() == ["gone"]
    assert run(world, tracker, "stays", 7.0, 1) == [None] * 3


def test_names_that_are_allowed(world: Any) -> None:
    tracker = tracker_of(world, allowed_devices="bus_[0-9]+")
    assert run(world, tracker, "bus_12", 0.0, 1) == [None] * 3
    assert run(world, tracker, "bus_x", 0.0, 1) == ["not_allowed"] * 3
    assert run(world, tracker, "a_bus_12", 0.0, 1) == ["not_allowed"] * 3
    (line,) = [f for f in tracker.findings({}, {}) if f.subject == "rsus"]
    assert "(not_allowed; the last: 'a_bus_12'): allowed_devices does not match" in line.message


def test_a_pattern_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"allowed_devices '\(' is no regular expression"):
        TrackerConfig(allowed_devices="(")
