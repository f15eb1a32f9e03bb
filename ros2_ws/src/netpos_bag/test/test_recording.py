"""Log times of received messages."""

from __future__ import annotations

from pathlib import Path

import pytest
from netpos.bags import BagReader, BagWriter
from netpos_bag.conversions import clock_cdr, clock_ns
from netpos_bag.parameters import LogTime
from netpos_bag.recording import PATIENCE_NS, Recording
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock

CLOCK = "rosgraph_msgs/msg/Clock"
WALL_NS = 1_800_000_000_000_000_000


class Trial:
    """A recording whose messages are numbered by their payload."""

    def __init__(self, path: Path, log_time: LogTime) -> None:
        self.path = path
        self.recording = Recording(BagWriter(path), log_time)
        self.sent = 0

    def send(self, wall_ns: int) -> None:
        self.recording.message("/a", CLOCK, clock_cdr(self.sent), wall_ns)
        self.sent += 1

    def read(self) -> list[tuple[int, int]]:
        """(number, log time) in the order of the bag."""
        self.recording.close()
        with BagReader(self.path) as bag:
            return [(clock_ns(entry.cdr), entry.log_time_ns) for entry in bag.messages()]


def test_before_the_first_clock_nothing_is_stamped_0(tmp_path: Path) -> None:
    trial = Trial(tmp_path / "run", LogTime.AUTO)
    trial.send(WALL_NS)
    trial.recording.clock(0)  # a simulator that has not started
    trial.send(WALL_NS + 1)
    trial.recording.clock(500)
    trial.send(WALL_NS + 2)
    trial.recording.clock(700)
    trial.send(WALL_NS + 3)
    assert trial.read() == [(0, 500), (1, 500), (2, 500), (3, 700)]


def test_without_a_clock_publisher_it_is_system_time_after_a_second(tmp_path: Path) -> None:
    trial = Trial(tmp_path / "run", LogTime.AUTO)
    trial.send(WALL_NS)
    trial.recording.tick(WALL_NS, clock_is_published=False)
    trial.recording.tick(WALL_NS + PATIENCE_NS - 1, clock_is_published=False)
    assert trial.recording.waiting == 1
    trial.recording.tick(WALL_NS + PATIENCE_NS, clock_is_published=False)
    assert trial.recording.waiting == 0
    trial.recording.clock(5)  # too late: one bag, one time
    trial.send(WALL_NS + 9)
    assert trial.read() == [(0, WALL_NS), (1, WALL_NS + 9)]


def test_a_silent_clock_publisher_is_waited_for(tmp_path: Path) -> None:
    trial = Trial(tmp_path / "run", LogTime.AUTO)
    trial.send(WALL_NS)
    for seconds in range(10):
        trial.recording.tick(WALL_NS + seconds * PATIENCE_NS, clock_is_published=True)
    assert trial.recording.waiting == 1
    assert trial.read() == [(0, WALL_NS)]  # closed before it ticked


@pytest.mark.parametrize(
    ("log_time", "expected"), [(LogTime.SYSTEM, WALL_NS), (LogTime.CLOCK, 500)]
)
def test_forced_time(tmp_path: Path, log_time: LogTime, expected: int) -> None:
    trial = Trial(tmp_path / "run", log_time)
    trial.send(WALL_NS)
    trial.recording.tick(WALL_NS, clock_is_published=False)
    trial.recording.tick(WALL_NS + 2 * PATIENCE_NS, clock_is_published=False)
    trial.recording.clock(500)
    assert trial.read() == [(0, expected)]


def test_backward_jumps_are_counted(tmp_path: Path) -> None:
    trial = Trial(tmp_path / "run", LogTime.AUTO)
    for ns in (5, 6, 6, 4, 5):
        trial.recording.clock(ns)
    assert trial.recording.backward_jumps == 1
    trial.recording.close()


@pytest.mark.parametrize("ns", [0, 1, 999_999_999, 1_000_000_000, WALL_NS])
def test_clock_bytes_are_those_of_ros(ns: int) -> None:
    message = deserialize_message(clock_cdr(ns), Clock)
    assert message.clock.sec * 10**9 + message.clock.nanosec == ns
    assert clock_ns(serialize_message(message)) == ns
