"""RSUs whose clocks stand wrong: the majority counts, the stranger is named and taken again."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker, TrackerConfig

PLACES = {
    "a": (0.0, 0.0),
    "b": (60.0, 0.0),
    "c": (60.0, 40.0),
    "d": (0.0, 40.0),
    "e": (30.0, 50.0),
}
NS = 10**9
OFFSETS_S = [2.0, 10.0, 30.0, 37.0, 3600.0, -2.0, -10.0, -30.0, -37.0, -3600.0]
START_S = 5000.0


def place(t_s: float) -> Array:
    """A bent way at about 2 m/s."""
    return np.array([20.0 + 0.8 * t_s, 15.0 + 8.0 * math.sin(t_s / 6.0)])


class Run:
    """RSUs that range to a device ten times a second, with the clock errors they are given."""

    def __init__(self, names: str, **config: Any) -> None:
        self.names = names
        self.rng = np.random.default_rng(1)
        self.tracker = Tracker(TrackerConfig(**{"coverage_radius_m": 100.0, **config}))
        for name in names:
            info = RsuInfo(rsu_id=name, position=np.array([*PLACES[name], 0.0]))
            self.tracker.add_rsu(info)
        self.outputs: list[Any] = []
        self.errors: list[tuple[float, float]] = []

    def measured(self, t_s: float, name: str, offset_s: float, expected: int) -> RsuMeasurement:
        r = float(np.linalg.norm(place(t_s) - PLACES[name])) + self.rng.normal(scale=0.1)
        return RsuMeasurement(
            stamp_ns=round((START_S + t_s + offset_s) * NS),
            rsu_id=name,
            vue_id="v",
            expected=expected,
            fields=Field.RANGE,
            range_m=r,
            range_var=0.01,
        )

    def go(self, from_s: float, to_s: float, offsets: dict[str, float] | None = None) -> None:
        """Beacons from one second to another; the order of arrival changes from beacon to
        beacon."""
        for k in range(round(10 * from_s), round(10 * to_s)):
            t_s = k / 10
            for name in self.rng.permutation(list(self.names)):
                offset_s = (offsets or {}).get(name, 0.0)
                self.tracker.add(self.measured(t_s, name, offset_s, len(self.names)))
                for output in self.tracker.process():
                    self.keep(output, t_s)

    def keep(self, output: Any, now_s: float) -> None:
        self.outputs.append(output)
        if output.odometry is not None:
            at_s = output.odometry.stamp_ns / NS - START_S
            error = float(np.linalg.norm(output.odometry.position[:2] - place(at_s)))
            self.errors.append((now_s, error if abs(at_s - now_s) < 2.0 else math.inf))

    def rmse_m(self, from_s: float, to_s: float) -> float:
        """Of the odometry that came out in this time."""
        found = [error for t, error in self.errors if from_s <= t < to_s]
        assert len(found) >= 8 * (to_s - from_s)
        return math.sqrt(float(np.mean(np.square(found))))

    def words(self) -> dict[str, str]:
        return {name: s.words() for name, s in self.tracker.strangers().get("v", {}).items()}


@pytest.mark.parametrize("offset_s", OFFSETS_S)
@pytest.mark.parametrize("culprit", ["a", "c"])
def test_one_of_four_steps_and_comes_back(offset_s: float, culprit: str) -> None:
    run = Run("abcd")
    run.go(0.0, 20.0)
    run.go(20.0, 40.0, {culprit: offset_s})
    side = "ahead of" if offset_s > 0.0 else "behind"
    assert run.words() == {culprit: f"clock {abs(offset_s):.1f} s {side} three others"}
    run.go(40.0, 50.0)
    without = Run("".join(n for n in "abcd" if n != culprit))
    without.go(0.0, 50.0)
    assert run.rmse_m(20.0, 40.0) < 1.2 * without.rmse_m(20.0, 40.0)
    assert run.rmse_m(42.0, 50.0) < 1.2 * run.rmse_m(5.0, 20.0)
    assert run.words() == {}
    assert run.outputs[-1].status.used == 4
    assert run.tracker.rejected()["v"]["track_lost"] == 0


@pytest.mark.parametrize("offset_s", [30.0, 37.0, 600.0, 3600.0, -30.0, -3600.0])
def test_one_of_four_is_wrong_from_the_start(offset_s: float) -> None:
    for seed in range(4):  # who is heard first changes
        run = Run("abcd")
        run.rng = np.random.default_rng(seed)
        run.go(0.0, 20.0, {"b": offset_s})
        assert run.rmse_m(8.0, 20.0) < 0.3
        assert set(run.words()) == {"b"}
        run.go(20.0, 25.0)
        assert run.words() == {}
        assert run.outputs[-1].status.used == 4


def test_two_of_five_step_apart_from_each_other() -> None:
    run = Run("abcde")
    run.go(0.0, 10.0)
    run.go(10.0, 20.0, {"a": 30.0, "b": -20.0})
    assert run.rmse_m(10.0, 20.0) < 0.3
    words = run.words()
    assert words["a"].startswith("clock 30.0 s ahead of")
    assert words["b"].startswith("clock 20.0 s behind")


def test_the_time_of_all_may_step() -> None:
    """All were set right by 37 s, one after the other within two beacons."""
    run = Run("abcd")
    run.go(0.0, 10.0)
    run.go(10.0, 10.1, {"a": 37.0})
    run.go(10.1, 10.2, {"a": 37.0, "b": 37.0, "c": 37.0})
    everyone = dict.fromkeys("abcd", 37.0)
    count = len(run.outputs)
    run.go(10.2, 20.0, everyone)
    later = run.outputs[count:]
    assert run.words() == {}
    assert later[-1].status.used == 4
    assert later[-1].status.stamp_ns == round((START_S + 19.9 + 37.0) * NS)


def test_of_two_the_one_that_steps_is_the_stranger() -> None:
    run = Run("ab", require_initial_pose=False)
    run.go(0.0, 10.0)
    run.go(10.0, 20.0, {"b": 10.0})
    assert run.words() == {"b": "clock 10.0 s ahead of another"}
    run.go(20.0, 21.0)
    assert run.words() == {}


def test_a_single_rsu_whose_stamps_jump_is_believed() -> None:
    """Nobody contradicts it."""
    run = Run("abcd")
    run.go(0.0, 10.0)
    run.names = "a"
    run.go(10.0, 20.0, {"a": 30.0})
    assert run.words() == {}
    assert run.outputs[-1].status.stamp_ns == round((START_S + 19.9 + 30.0) * NS)


@pytest.mark.parametrize("silence_s", [1.5, 5.0, 20.0])
def test_after_a_silence_nothing_is_lost(silence_s: float) -> None:
    run = Run("abcd")
    run.go(0.0, 10.0)
    run.go(10.0 + silence_s, 15.0 + silence_s)
    assert run.tracker.rejected()["v"].total() == 0
    assert sum(o.status.used for o in run.outputs if not o.revised) == 4 * 150
    assert run.words() == {}


def test_what_waits_at_the_end_is_not_lost() -> None:
    run = Run("abcd")
    run.go(0.0, 10.0)
    item = run.measured(15.0, "a", 0.0, 1)
    assert run.tracker.add(item) is None
    assert run.tracker.process() == []
    (output,) = run.tracker.flush()
    assert output.status.stamp_ns == item.stamp_ns


def test_delayed_messages_do_not_take_the_time_back() -> None:
    """Two of three RSUs are cut off for 5 s; then all that was held up comes at once."""
    run = Run("abc")
    run.go(0.0, 10.0)
    held = []
    for k in range(100, 150):
        for name in "abc":
            item = run.measured(k / 10, name, 0.0, 3)
            if name == "a":
                run.tracker.add(item)
                for output in run.tracker.process():
                    run.keep(output, k / 10)
            else:
                held.append(item)
    for item in held:
        run.tracker.add(item)
        for output in run.tracker.process():
            run.keep(output, 15.0)
    run.go(15.0, 20.0)
    assert run.rmse_m(16.0, 20.0) < 0.3
    assert run.outputs[-1].status.used == 3
    assert run.words() == {}


def test_order_within_a_beacon_changes_nothing_that_is_told() -> None:
    """The same measurements in another order of the RSUs."""
    told = []
    for order in ("abcd", "dcba"):
        run = Run("abcd")
        items = [
            [run.measured(k / 10, n, 30.0 if n == "b" and k > 50 else 0.0, 4) for n in "abcd"]
            for k in range(100)
        ]
        for beacon in items:
            by_name = {m.rsu_id: m for m in beacon}
            for name in order:
                run.tracker.add(replace(by_name[name]))
                for output in run.tracker.process():
                    run.keep(output, 0.0)
        last = run.outputs[-1].odometry
        assert last is not None
        told.append((last.stamp_ns, last.position.tobytes()))
    assert told[0] == told[1]
