"""What is played, and in which order."""

from __future__ import annotations

from pathlib import Path

import pytest
from netpos.bags import BagError, BagReader, BagWriter
from netpos_bag.conversions import clock_cdr
from netpos_bag.parameters import PlayConfig
from netpos_bag.playback import LATCHED_LEAD_NS, NS, Plan, chosen_topics

CLOCK = "rosgraph_msgs/msg/Clock"
TOPICS = (
    "/clock",
    "/diagnostics",
    "/parameter_events",
    "/rosout",
    "/rsu/info",
    "/rsu/measurements",
    "/tf",
    "/vue_1/clock_state",
    "/vue_1/ground_truth",
    "/vue_1/odometry",
    "/vue_1/step_velocity",
    "/vue_1/track_status",
)
BAG = Path("x")


def test_clock_and_logs_of_the_recorded_processes_are_never_played() -> None:
    chosen = chosen_topics(TOPICS, PlayConfig(bag=BAG))
    assert set(TOPICS) - set(chosen) == {"/clock", "/parameter_events", "/rosout"}


def test_input_only_leaves_out_what_the_tracker_publishes() -> None:
    assert chosen_topics(TOPICS, PlayConfig(bag=BAG, input_only=True)) == [
        "/rsu/info",
        "/rsu/measurements",
        "/vue_1/ground_truth",
        "/vue_1/step_velocity",
    ]


def test_patterns() -> None:
    config = PlayConfig(bag=BAG, topics=("/vue_1/*", "/tf"), exclude_topics=("/*/c*",))
    assert "/tf" in chosen_topics(TOPICS, config)
    assert "/vue_1/clock_state" not in chosen_topics(TOPICS, config)
    with pytest.raises(BagError, match="no topic /nothing"):
        chosen_topics(TOPICS, PlayConfig(bag=BAG, topics=("/nothing",)))
    with pytest.raises(BagError, match="no topic is left"):
        chosen_topics(TOPICS, PlayConfig(bag=BAG, exclude_topics=("/*",)))


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """/rsu/info at 0, 0.5 and 3 s; /a every half second to 4 s; the times are the payloads."""
    times = [("/rsu/info", 0), ("/rsu/info", NS // 2), ("/rsu/info", 3 * NS)]
    times += [("/a", i * NS // 2) for i in range(9)]
    with BagWriter(tmp_path / "run") as writer:
        for topic, ns in sorted(times, key=lambda item: item[1]):
            writer.write_raw(topic, CLOCK, clock_cdr(ns), 10 * NS + ns)
    return tmp_path / "run"


def test_latched_first_then_log_order_with_clock_before(bag: Path) -> None:
    config = PlayConfig(bag=bag, rate=2.0, clock_hz=4.0)
    with BagReader(bag) as reader:
        plan = Plan.make(reader, config)
        assert [e.log_time_ns - 10 * NS for e in plan.leading()] == [0, NS // 2]
        events = [(ns - 10 * NS, entry and entry.topic) for ns, entry in plan.events()]
    assert LATCHED_LEAD_NS == NS
    expected: list[tuple[int, str | None]] = []
    for i in range(9):  # a tick each half second of the bag: rate / clock_hz
        expected.append((i * NS // 2, None))
        if i == 6:
            expected.append((3 * NS, "/rsu/info"))
        expected.append((i * NS // 2, "/a"))
    assert events[:-1] == expected
    assert events[-1] == (9 * NS // 2, None)


def test_start_offset(bag: Path) -> None:
    with BagReader(bag) as reader:
        plan = Plan.make(reader, PlayConfig(bag=bag, start_offset=2.25))
        assert [e.log_time_ns - 10 * NS for e in plan.leading()] == [0, NS // 2, 3 * NS]
        played = [entry for _, entry in plan.events() if entry is not None]
        assert [e.log_time_ns - 10 * NS for e in played] == [
            5 * NS // 2,
            3 * NS,
            7 * NS // 2,
            4 * NS,
        ]
        with pytest.raises(BagError, match=r"the bag lasts 4\.000 s"):
            Plan.make(reader, PlayConfig(bag=bag, start_offset=4.1))
