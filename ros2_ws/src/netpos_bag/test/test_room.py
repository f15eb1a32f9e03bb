"""When a recording is warned of a full disk, and when it ends."""

from __future__ import annotations

from pathlib import Path

import pytest
from netpos_bag.room import MEGABYTE, Level, Room


@pytest.mark.parametrize(
    ("free_mb", "level"),
    [
        (1001, Level.OK),
        (999, Level.WARN),
        (100, Level.WARN),
        (99.9, Level.ERROR),
        (0, Level.ERROR),
    ],
)
def test_level_by_what_is_free(free_mb: float, level: Level) -> None:
    room = Room(Path("/bags"), 100.0, lambda _: int(free_mb * MEGABYTE))
    assert room.look(0.0) is level
    assert (room.sentence == "") is (level is Level.OK)


@pytest.mark.parametrize(("used_mb", "level"), [(9.0, Level.OK), (11.0, Level.WARN)])
def test_warns_a_minute_before_the_end(used_mb: float, level: Level) -> None:
    """5000 MB with 4400 above the limit; a tenth of it in six seconds is a minute."""
    left = iter([10_000, 10_000, 5_000, 5_000])
    room = Room(Path("/bags"), 100.0, lambda _: next(left) * MEGABYTE)
    room.look(0.0)
    seconds = 5_000 / (4_900 / 60) * 10.0 / used_mb
    assert room.look(seconds) is level
    if level is Level.WARN:
        assert "full in" in room.sentence


def test_sentence_has_values_and_remedy() -> None:
    room = Room(Path("/bags"), 100.0, lambda _: 50 * MEGABYTE)
    room.look(0.0)
    assert room.sentence == (
        "50.0 MB are free for /bags, less than 100 (--min-free-mb); make room there, or record "
        "to another disk"
    )
