"""What is refused is counted by device and RSU, and said with value and remedy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.bags import codec
from netpos.messages.fields import stamp_ns
from netpos.messages.values import (
    Field,
    ImuSample,
    InitialPose,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    Velocity,
)
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.door.refusals import OTHERS, SOURCES_MAX, WINDOW, Refusals

S = 1_000_000_000
T0 = 100 * S
SITES = {"a": (0.0, 0.0), "b": (40.0, 0.0), "c": (0.0, 40.0)}
PLACE = np.array([12.0, 9.0, 0.0])


def info(name: str, **change: Any) -> RsuInfo:
    return RsuInfo(rsu_id=name, position=np.array([*SITES.get(name, (5.0, 5.0)), 0.0]), **change)


def measured(name: str = "a", at_s: float = 0.0, **change: Any) -> RsuMeasurement:
    distance = float(np.linalg.norm(PLACE - info(name).position))
    values: dict[str, Any] = {
        "stamp_ns": T0 + round(at_s * S),
        "rsu_id": name,
        "vue_id": "vue_1",
        "fields": Field.RANGE,
        "range_m": distance,
        "range_var": 0.01,
        "expected": 3,
    }
    return RsuMeasurement(**{**values, **change})


def tracker(**config: Any) -> Tracker:
    made = Tracker(TrackerConfig(**config))
    for name in SITES:
        made.add_rsu(info(name))
    return made


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"range_var": 0.0}, "variance: range_var is 0 m^2; send one from 1e-12 to 1e+12"),
        ({"range_m": float("nan")}, "not_finite: range_m is nan m; leave out what was not"),
        ({"stamp_ns": 0}, "zero_stamp: header.stamp is 0; set it to the time of emission"),
        ({"fields": Field(0)}, "no_fields: fields is 0; set the bits of what was measured"),
        ({"fields": Field.RANGE | 1 << 20}, "unknown_fields: fields is 1048584, of which only"),
        ({"rsu_id": "r9"}, "unknown_rsu: no RsuInfo of it is known; publish it on /rsu/info"),
        ({"lever_arm": (2e3, 0.0, 0.0)}, "lever_arm: lever_arm is (2000.0, 0.0, 0.0) m"),
        (
            {"fields": Field.TDOA, "tdoa_var": 1e-18},
            "no_reference: reference_rsu_id is ''; name the RSU that the TDOA counts from",
        ),
        (
            {"fields": Field.TDOA, "tdoa_var": 1e-18, "reference_rsu_id": "r9"},
            "unknown_reference: no RsuInfo of the reference 'r9' is known",
        ),
        (
            {"fields": Field.TDOA, "tdoa_var": 1e-18, "tdoa_s": 1e-3, "reference_rsu_id": "b"},
            "tdoa_too_large: tdoa is 0.001 s, more than the distance of the two RSUs allows",
        ),
        (
            {"fields": Field.PHASE, "phase_difference_var": 0.1},
            "no_baseline: its RsuInfo has no baseline",
        ),
        (
            {
                "fields": Field.POSITION,
                "frame_id": "odom",
                "position": PLACE,
                "position_cov": np.eye(3),
            },
            "frame: frame_id is 'odom'; give it in 'map'",
        ),
        (
            {"fields": Field.POSITION, "position": PLACE, "position_cov": np.zeros((3, 3))},
            "variance: a covariance is not symmetric and positive definite",
        ),
    ],
)
def test_the_first_status_says_what_was_refused(change: dict[str, Any], sentence: str) -> None:
    made = tracker()
    assert made.add(measured(**change)) is not None
    (told,) = made.process()
    assert told.odometry is None
    assert told.status.state is TrackState.WAITING
    assert told.status.reason.startswith(f"all refused: {sentence}")
    rsu = change.get("rsu_id", "a")
    assert told.status.reason.endswith(f"(from {rsu})")
    assert made.refusals.rsus()[rsu].words().startswith(f"all refused: {sentence}")
    assert sum(told.status.rejected.values()) == 1


def test_a_device_that_is_always_refused_is_told_of_again_and_again() -> None:
    made, told = tracker(), []
    for k in range(100):
        made.add(measured("abc"[k % 3], 0.1 * (k // 3), range_var=0.0))
        told += made.process()
    assert len(told) == 10
    assert told[-1].status.rejected == {"variance": 91}
    assert {t.status.stamp_ns for t in told} != {0}


def test_shares_follow_what_is_taken() -> None:
    made = tracker()
    for k in range(WINDOW):
        made.add(measured("a", 0.1 * k, range_var=0.0))
        made.add(measured("b", 0.1 * k, expected=2))
        made.add(measured("c", 0.1 * k, expected=2))
        made.process()
    device, rsus = made.refusals.of_device("vue_1"), made.refusals.rsus()
    assert set(rsus) == {"a"}
    assert rsus["a"].all_of_it
    assert not device.all_of_it
    assert device.words().startswith("16 of the last 50 refused: variance: range_var is 0 m^2")
    for k in range(WINDOW):
        made.add(measured("a", 10.0 + 0.1 * k))
        made.process()
    assert made.refusals.of_device("vue_1").words() == ""
    assert made.refusals.rsus()["a"].counts == {"variance": 50}


def test_a_refused_description_explains_the_measurements() -> None:
    made = Tracker()
    bad = info("a", range_bias_sd_m=-1.0)
    with pytest.raises(ValueError, match="bias sd of a must be finite"):
        made.add_rsu(bad)
    assert made.refusals.descriptions() == {"a": "bias sd of a must be finite and >= 0"}
    made.add(measured())
    (told,) = made.process()
    assert "unknown_rsu: its RsuInfo was refused: bias sd of a" in told.status.reason
    made.add_rsu(info("a"))
    assert made.refusals.descriptions() == {}


def test_stamps_are_said_in_seconds() -> None:
    made = tracker()
    for k in range(20):
        for name in SITES:
            made.add(measured(name, 0.1 * k))
            made.process()
    assert made.add(measured("a", -5.0)) == "late"
    assert made.refusals.rsus()["a"].sentence.startswith("late: its stamp is 6.9 s behind the new")
    assert made.add(measured("b", 1.9)) == "duplicate"
    assert "another one with the same stamp" in made.refusals.rsus()["b"].sentence


def test_other_items_are_counted_under_their_device() -> None:
    made = tracker(motion_model="inertial")
    zero = np.zeros(2)
    made.add(Velocity(stamp_ns=T0, vue_id="v", source="w", velocity=zero, cov=-np.eye(2)))
    made.add(InitialPose(stamp_ns=T0, vue_id="v", position=PLACE, cov=np.eye(3), frame_id="odom"))
    nan = np.full(3, np.nan)
    made.add(ImuSample(stamp_ns=T0, vue_id="v", angular_velocity=nan, specific_force=PLACE))
    assert made.refusals.of_device("v").counts == {"variance": 1, "frame": 1, "not_finite": 1}
    assert made.refusals.rsus() == {}
    assert made.rejected()["v"] == {"variance": 1, "frame": 1, "imu_not_finite": 1}


def test_a_disabled_tracker_says_so() -> None:
    made = tracker()
    made.enabled = False
    made.add(measured())
    (told,) = made.process()
    assert "disabled: the tracker is disabled; call its service" in told.status.reason


def test_a_name_that_is_no_topic_is_counted_but_told_of_nowhere() -> None:
    made = tracker()
    assert made.add(measured(vue_id="no spaces")) == "vue_id"
    assert made.process() == []
    assert "'no spaces' is no name of a topic" in made.refusals.rsus()["a"].sentence


def test_memory_is_bounded() -> None:
    refusals = Refusals()
    for k in range(SOURCES_MAX + 7):
        refusals.refuse(measured(vue_id=f"v{k}", rsu_id=f"r{k}"), "unknown_rsu")
        refusals.refuse_description(f"r{k}", "bad")
    assert len(refusals.devices()) == len(refusals.rsus()) == SOURCES_MAX + 1
    assert refusals.of_device(OTHERS).counts == {"unknown_rsu": 7}
    assert len(refusals.descriptions()) == SOURCES_MAX


# what a first fix lacks


def waits(made: Tracker, *items: RsuMeasurement) -> str:
    for item in items:
        made.add(item)
    told = made.flush()
    assert told[-1].status.state is TrackState.WAITING
    return told[-1].status.reason


def test_ranges_in_millimetres() -> None:
    far = [replace(m, range_m=1e3 * m.range_m) for m in map(measured, SITES)]
    reason = waits(tracker(), *far)
    assert reason.startswith("RANGE of a, b, c contradict each other by ")
    assert reason.endswith("are they in m, rad and s, and the RSUs where RsuInfo says?")


def test_one_range_is_not_enough() -> None:
    reason = waits(tracker(), measured(expected=1))
    assert reason.startswith("RANGE of a leave a position sd of ")
    assert "another RSU or quantity is needed" in reason


def test_two_ranges_fit_two_places() -> None:
    reason = waits(tracker(), measured("a", expected=2), measured("b", expected=2))
    assert reason.startswith("more than one place fits RANGE of a, b")


def test_a_pose_is_waited_for_and_then_done_without() -> None:
    made, told = tracker(require_initial_pose=True, initial_pose_wait_s=2.0, hold_s=0.1), []
    for k in range(40):
        for name in SITES:
            made.add(measured(name, 0.1 * k))
            told += made.process()
    reasons = [t.status.reason for t in told]
    assert reasons[0].startswith("waits for a pose on /vue_1/initialpose, up to 2 s from the")
    fixed = [t.status.stamp_ns for t in told if t.odometry is not None]
    assert fixed[0] == T0 + 2 * S
    assert reasons[-1] == ""
    assert told[-1].status.rejected == {"no_initial_pose": 60}


# silence


def test_a_device_nobody_hears_is_coasting() -> None:
    made, told = tracker(), []
    for k in range(20):
        for name in SITES:
            made.add(measured(name, 0.1 * k))
            told += made.process()
    last = told[-1].status
    assert made.coasting("vue_1", last.stamp_ns + S // 10) is None
    later = made.coasting("vue_1", last.stamp_ns + 5 * S)
    assert later is not None
    assert later.odometry is None
    assert later.status.state is TrackState.COASTING
    assert later.status.reason == "nothing taken for 5.0 s"
    assert later.status.position_sd_m > 2.0 * last.position_sd_m
    assert made.coasting("nobody", T0) is None
    for name in SITES:  # nothing has changed
        made.add(measured(name, 2.0))
    (after,) = made.process()
    assert after.status.state is TrackState.TRACKING
    assert after.status.position_sd_m == pytest.approx(last.position_sd_m, rel=0.1)


def test_a_time_that_is_none_is_told_of_the_device_and_the_rsu() -> None:
    """It does not set the time of its device back, nor forward."""
    made = tracker()
    stamp = codec().time(T0)
    stamp.nanosec = 4 * 10**9
    for name in SITES:
        made.add(measured(name))
    before = made.process()
    for _ in range(30):
        assert made.add(measured("a", stamp_ns=stamp_ns(stamp))) == "bad_stamp"
    words = "bad_stamp: header.stamp.nanosec is 4000000000; send one below 1000000000"
    assert made.refusals.of_device("vue_1").sentence == f"{words} (from a)"
    assert made.refusals.rsus()["a"].sentence == words
    assert made.rejected()["vue_1"]["bad_stamp"] == 30
    for name in SITES:
        made.add(measured(name, at_s=0.1))
    after = made.process()
    assert before
    assert after[-1].status.stamp_ns == T0 + S // 10
