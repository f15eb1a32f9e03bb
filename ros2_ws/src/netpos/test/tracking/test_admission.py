"""Which devices are tracked: names cost nothing to invent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Field, InitialPose, RsuMeasurement
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


def test_names_of_which_something_sound_came_displace_each_other_and_no_track(world: Any) -> None:
    """One epoch each: a fix that nothing confirms. The honest device gets its place between."""
    tracker = tracker_of(world, max_devices=10)
    assert run(world, tracker, "tracked", 0.0, 3) == [None] * 9
    reasons: list[str | None] = []
    honest: list[str | None] = []
    for k in range(3000):
        name = f"made_up_{k}"
        reasons += run(world, tracker, name, 0.3 + k * 1e-3, 1)  # a fix, and no second epoch
        if k % 100 == 50:
            honest += run(world, tracker, "honest", 0.3 + k * 1e-3, 1)
    assert reasons.count(None) == 3  # the one that found no other candidate
    assert honest == ["too_many_devices"] * 3 + [None] * 87
    assert not {"tracked", "honest"} & set(tracker.take_left())
    assert {"tracked", "honest"} <= set(tracker.rejected())
    assert len(tracker.rejected()) == 3


def test_a_candidate_that_was_heard_more_often_stays(world: Any) -> None:
    """It has no fix, because it needs a pose; names that are heard once leave before it."""
    tracker = tracker_of(world, max_devices=3, require_initial_pose=True)
    for k in range(40):
        assert run(world, tracker, "waits", 0.1 * k, 1) == [None] * 3
        run(world, tracker, f"made_up_{k // 2}", 0.1 * k, 1)
        assert tracker.lacks_something("waits") is (k >= 30)
    assert "waits" not in tracker.take_left()
    run(world, tracker, "waits", 4.0, 1)
    assert tracker.lacks_something("waits")
    assert not tracker.lacks_something("made_up_19")
    assert not tracker.lacks_something("nobody")


def test_devices_that_are_given_poses_enter_all_at_once(world: Any) -> None:
    """They need no first fix that takes time of the others, and leave room for those that do."""
    tracker = tracker_of(world, max_devices=20)
    start_ns = heard(world, "bus_0", 0.0)[0].stamp_ns
    place = np.append(truth(0.0)[:2], 0.0)
    for k in range(10):
        pose = InitialPose(stamp_ns=start_ns, vue_id=f"bus_{k}", position=place, cov=np.eye(3))
        assert tracker.add(pose) is None
    tracker.process()
    found = [run(world, tracker, f"bus_{k}", 0.0, 1) for k in range(10)]
    assert found == [[None] * 3] * 10
    seekers = [run(world, tracker, f"tag_{k}", 0.0, 1) for k in range(3)]
    assert seekers == [[None] * 3] * 2 + [["too_many_devices"] * 3]


def test_a_replay_admits_the_same(world: Any) -> None:
    def who_stays() -> set[str]:
        tracker = tracker_of(world, max_devices=5)
        for k in range(60):
            run(world, tracker, f"name_{(k * k) % 17}", 0.05 * k, 1)
            tracker.add(heard(world, f"once_{k}", 0.05 * k)[0])
        return set(tracker.rejected())

    assert who_stays() == who_stays()
    assert len(who_stays()) == 5


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
