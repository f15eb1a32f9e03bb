"""Lies that nothing can notice: the measurements are those of another device, which tells no lie.

What the honest device would be measured with is computed here, not by the fault.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from netpos.evaluation.faults import FAULTS
from netpos.evaluation.faults.stream import NS, Arrival, Hit, Stream
from netpos.evaluation.faults.tracking import Answer, answer_to
from netpos.evaluation.pairing import Trajectory
from netpos.messages.values import (
    Array,
    Field,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    Velocity,
)
from netpos.tracking import TrackerConfig

PLACES = {
    "a": (0.0, 0.0, 4.0),
    "b": (60.0, 0.0, 4.0),
    "c": (60.0, 50.0, 4.0),
    "d": (0.0, 50.0, 4.0),
}
SCENE = {name: RsuInfo(rsu_id=name, position=np.array(p)) for name, p in PLACES.items()}
START_S, END_S, LIE_M = 4.0, 14.0, 8.0
CONFIG = TrackerConfig(device_height_m=0.0)


def honest(t_s: float) -> Array:
    """Where the device that is lied about is: 2 m/s to the east."""
    return np.array([10.0 + 2.0 * t_s, 20.0, 0.0])


def other(t_s: float) -> Array:
    """Where the lie puts it: ever further to the north-east."""
    away_m = LIE_M * max(t_s - START_S, 0.0) / (END_S - START_S)
    return honest(t_s) + away_m * np.sqrt(0.5) * np.array([1.0, 1.0, 0.0])


def measured(places: dict[str, object]) -> Stream:
    """What RSUs measure of a device that is, for each, where ``places`` has it; the noise is the
    same whoever it is."""
    rng, found = np.random.default_rng(2), []
    for k in range(1, round(10 * END_S)):
        stamp = k * NS // 10
        for name, at in PLACES.items():
            place = places[name](stamp / NS)  # type: ignore[operator]
            range_m = float(np.linalg.norm(place - np.array(at))) + 0.1 * rng.standard_normal()
            m = RsuMeasurement(
                stamp_ns=stamp,
                rsu_id=name,
                vue_id="v",
                expected=len(PLACES),
                fields=Field.RANGE,
                range_m=range_m,
                range_var=0.01,
            )
            found.append(Arrival(stamp, m))
    return found


def struck(stream: Stream, rsus: str, fault: str = "creeping") -> Stream:
    """With a fault of some of the RSUs, of which a lie is about the honest device."""
    still = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
    stamps = [k * NS // 10 for k in range(round(10 * END_S) + 1)]
    truth = [
        Odometry(
            stamp_ns=s,
            vue_id="v",
            position=honest(s / NS),
            quaternion=still[0],
            linear_velocity=still[1],
        )
        for s in stamps
    ]
    hit = Hit(
        start_ns=round(START_S * NS),
        end_ns=round(END_S * NS),
        rsus=frozenset(rsus),
        size=LIE_M,
        rng=np.random.default_rng(1),
        scene=SCENE,
        truth={"v": Trajectory.of(truth)},
    )
    return FAULTS[fault].apply(stream, hit)


def heard(stream: Stream) -> Array:
    return np.array([a.what.range_m for a in stream if isinstance(a.what, RsuMeasurement)])


def answer(stream: Stream) -> Answer:
    return answer_to(stream, CONFIG, SCENE, ["v"])


@pytest.fixture(scope="module")
def answers() -> tuple[Answer, Answer]:
    """Of a lie of everybody about the honest device, and of the truth about the other one."""
    lied = struck(measured(dict.fromkeys(PLACES, honest)), "abcd")
    true = measured(dict.fromkeys(PLACES, other))
    np.testing.assert_allclose(heard(lied), heard(true), rtol=0.0, atol=1e-9)
    return answer(lied), answer(true)


def test_a_lie_of_everybody_is_the_truth_of_another_device(
    answers: tuple[Answer, Answer],
) -> None:
    """To call the first one anything but TRACKING is to call the second one so."""
    lied, true = answers
    ours, theirs = (np.array([o.position for o in a.odometry["v"]]) for a in answers)
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-6)
    for one, two in zip(lied.statuses["v"].values(), true.statuses["v"].values(), strict=True):
        assert one.state is two.state
        assert one.protection_level_m == pytest.approx(two.protection_level_m, abs=1e-6)
    assert lied.refused == true.refused
    newest = true.odometry["v"][-1]
    error = float(np.hypot(*(newest.position - other(newest.stamp_ns / NS))[:2]))
    status = true.statuses["v"][newest.stamp_ns]
    assert status.state is TrackState.TRACKING
    assert error < status.protection_level_m < LIE_M / 4


def test_of_two_that_contradict_each_other_either_may_lie() -> None:
    """Two RSUs say that the device is at one place, the two others at another one: the same is
    measured whichever pair lies, and about another device."""
    pairs = dict.fromkeys("ab", other) | dict.fromkeys("cd", honest)
    first = struck(measured(dict.fromkeys(PLACES, honest)), "ab")
    np.testing.assert_allclose(heard(first), heard(measured(pairs)), rtol=0.0, atol=1e-9)
    mirrored = [
        a if a.what.rsu_id in "ab" else Arrival(a.at_ns, _moved(a.what))
        for a in measured(dict.fromkeys(PLACES, other))
        if isinstance(a.what, RsuMeasurement)
    ]
    np.testing.assert_allclose(heard(first), heard(mirrored), rtol=0.0, atol=1e-9)


def _moved(m: RsuMeasurement) -> RsuMeasurement:
    """Said of the other device by an RSU that puts it where the honest one is."""
    t_s, at = m.stamp_ns / NS, np.array(PLACES[m.rsu_id])
    lie_m = np.linalg.norm(honest(t_s) - at) - np.linalg.norm(other(t_s) - at)
    return replace(m, range_m=m.range_m + float(lie_m))


def walker(*, stops: bool) -> Stream:
    """A walker whose steps say 2 m/s to the east; ranges, with steps of 0.5 m and without noise,
    of one who does so, or of one who ``stops`` at the start and steps on the spot."""
    found = []
    for k in range(1, round(10 * END_S)):
        stamp = k * NS // 10
        t_s = min(stamp / NS, START_S) if stops else stamp / NS
        step = np.array([2.0, 0.0]), 4.0 * np.eye(2)
        velocity = Velocity(stamp_ns=stamp, vue_id="v", velocity=step[0], cov=step[1])
        found.append(Arrival(stamp, velocity))
        if k % 10:
            continue
        for name, at in PLACES.items():
            range_m = 0.5 * round(2.0 * float(np.linalg.norm(honest(t_s) - np.array(at))))
            m = RsuMeasurement(
                stamp_ns=stamp,
                rsu_id=name,
                vue_id="v",
                expected=len(PLACES),
                fields=Field.RANGE,
                range_m=range_m,
                range_var=0.04,
            )
            found.append(Arrival(stamp, m))
    return found


def test_frozen_rsus_are_those_of_a_walker_who_steps_on_the_spot() -> None:
    """Either all RSUs are stuck or the steps are wrong. The numbers are the same, so is the
    answer, and the second walker is where the track is."""
    stuck = struck(walker(stops=False), "abcd", fault="freeze")
    spot = walker(stops=True)
    np.testing.assert_allclose(heard(stuck), heard(spot), rtol=0.0, atol=0.0)
    ours, theirs = answer(stuck), answer(spot)
    covered = 0
    for one, two in zip(ours.odometry["v"], theirs.odometry["v"], strict=True):
        np.testing.assert_array_equal(one.position, two.position)
        status = ours.statuses["v"][one.stamp_ns]
        assert status == theirs.statuses["v"][one.stamp_ns]
        t_s = one.stamp_ns / NS
        ranged = one.stamp_ns % NS == 0
        if ranged and status.state is TrackState.TRACKING and START_S < t_s < END_S:
            here = float(np.hypot(*(two.position - honest(START_S))[:2]))
            assert here < status.protection_level_m
            away = float(np.hypot(*(one.position - honest(t_s))[:2]))
            covered += away > status.protection_level_m
    assert covered > 2


def carried(*, walks: bool) -> Stream:
    """A device that rests until the start; then a moving walkway carries it to the east, or, where
    it ``walks``, steps do so. Ranges each second; dead reckoning says rest, or the truth."""
    rng, found = np.random.default_rng(4), []
    for k in range(1, round(10 * END_S)):
        stamp = k * NS // 10
        east_m = max(stamp / NS - START_S, 0.0)
        stepping = walks and east_m > 0.0
        velocity = np.array([1.0, 0.0]) if stepping else np.zeros(2)
        said = Velocity(stamp_ns=stamp, vue_id="v", velocity=velocity, cov=0.01 * np.eye(2))
        found.append(Arrival(stamp, said))
        if k % 10:
            continue
        for name, at in PLACES.items():
            place = honest(0.0) + np.array([east_m, 0.0, 0.0])
            range_m = float(np.linalg.norm(place - np.array(at))) + 0.1 * rng.standard_normal()
            m = RsuMeasurement(
                stamp_ns=stamp,
                rsu_id=name,
                vue_id="v",
                expected=len(PLACES),
                fields=Field.RANGE,
                range_m=range_m,
                range_var=0.01,
            )
            found.append(Arrival(stamp, m))
    return found


def said_by_steps(stream: Stream) -> list[tuple[int, list[float], list[list[float]]]]:
    reported = [a.what for a in stream if isinstance(a.what, Velocity)]
    return [(v.stamp_ns, v.velocity.tolist(), v.cov.tolist()) for v in reported]


def test_steps_that_are_stuck_at_rest_are_those_of_a_walker_who_is_carried() -> None:
    """A source that is stuck while the device rests goes on saying that it rests. So does that of
    a person on a moving walkway, which is sound: message by message they are the same."""
    stuck = struck(carried(walks=True), "", fault="device_frozen")
    walkway = carried(walks=False)
    assert said_by_steps(stuck) == said_by_steps(walkway) != said_by_steps(carried(walks=True))
    np.testing.assert_array_equal(heard(stuck), heard(walkway))
    ours, theirs = answer(stuck), answer(walkway)
    assert ours.refused == theirs.refused
    for one, two in zip(ours.odometry["v"], theirs.odometry["v"], strict=True):
        np.testing.assert_array_equal(one.position, two.position)
        assert ours.statuses["v"][one.stamp_ns] == theirs.statuses["v"][two.stamp_ns]
