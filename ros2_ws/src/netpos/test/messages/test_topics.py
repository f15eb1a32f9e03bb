"""Topic names of the interface contract."""

from __future__ import annotations

import pytest
from netpos.messages import topics


def test_names_of_the_contract() -> None:
    assert topics.CLOCK == "/clock"
    assert topics.RSU_INFO == "/rsu/info"
    assert topics.RSU_MEASUREMENTS == "/rsu/measurements"
    assert topics.DIAGNOSTICS == "/diagnostics"
    assert topics.TF == "/tf"
    per_device = [
        topics.BEACON,
        topics.GROUND_TRUTH,
        topics.GROUND_TRUTH_CLOCK,
        topics.IMU,
        topics.MAG,
        topics.STEP,
        topics.STEP_VELOCITY,
        topics.INITIAL_POSE,
        topics.ODOMETRY,
        topics.CLOCK_STATE,
        topics.TRACK_STATUS,
    ]
    assert [topics.of_vue("vue_1", name) for name in per_device] == [
        "/vue_1/beacon",
        "/vue_1/ground_truth",
        "/vue_1/ground_truth_clock",
        "/vue_1/imu",
        "/vue_1/mag",
        "/vue_1/step",
        "/vue_1/step_velocity",
        "/vue_1/initialpose",
        "/vue_1/odometry",
        "/vue_1/clock_state",
        "/vue_1/track_status",
    ]


@pytest.mark.parametrize(
    ("topic", "parts"),
    [
        ("/vue_1/beacon", ("vue_1", "beacon")),
        ("vue_1/beacon/", ("vue_1", "beacon")),
        ("/rsu/info", ("", "/rsu/info")),
        ("/clock", ("", "/clock")),
        ("/a/b/c", ("", "/a/b/c")),
    ],
)
def test_split_is_the_inverse_of_of_vue(topic: str, parts: tuple[str, str]) -> None:
    assert topics.split(topic) == parts


@pytest.mark.parametrize(
    ("topic", "ours"),
    [
        ("/vue_1/odometry", True),
        ("/vue_9/clock_state", True),
        ("/vue_1/track_status", True),
        ("/tf", True),
        ("/diagnostics", True),
        ("/vue_1/ground_truth", False),
        ("/vue_1/step_velocity", False),
        ("/rsu/measurements", False),
        ("/clock", False),
        ("/a/b/odometry", False),
    ],
)
def test_what_the_tracker_publishes(topic: str, ours: bool) -> None:
    assert topics.is_tracker_output(topic) is ours


@pytest.mark.parametrize("good", ["vue_1", "V", "_x", "a1b2", 100 * "x"])
def test_device_names(good: str) -> None:
    assert topics.is_vue_id(good)


@pytest.mark.parametrize("bad", ["", "1st", "a b", "a/b", "a-b", "ü", "a.b", "{x}", 101 * "x"])
def test_what_names_no_device(bad: str) -> None:
    assert not topics.is_vue_id(bad)


def test_topics_of_the_longest_names_are_topics() -> None:
    longest = topics.of_vue(100 * "x", topics.ODOMETRY_SMOOTHED, 100 * "n")
    assert len(longest) <= 247
