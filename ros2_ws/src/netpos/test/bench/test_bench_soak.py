"""Rows of the soak: memory that grows, latency that drifts and what is lost are seen."""

from __future__ import annotations

from typing import Any

import pytest
from netpos.bench.common import Row, as_json
from netpos.bench.soak import day, live_rows


def figures(**change: Any) -> dict[str, Any]:
    samples = [
        {
            "hours": k / 60,
            "memory_mb": 200.0,
            "recorder_memory_mb": 90.0,
            "lag_median_s": 0.002,
            "missing": 0,
            "not_finite": 0,
            "largest_error_m": 3.0,
        }
        for k in range(1, 61)
    ]
    counts = {
        "devices": 10,
        "seconds": 3600.0,
        "sent": 720_000,
        "handled": 720_000,
        "odometry": 360_000,
        "recorded_measurements": 720_000,
        "recorded_odometry": 360_000,
    }
    return {**counts, "samples": samples, **change}


def rows(made: dict[str, Any]) -> dict[str, Row]:
    found = {}
    for row in live_rows(made):
        assert isinstance(row, Row)
        found[row.name.partition(": ")[2]] = row
    return found


def bad(made: dict[str, Any]) -> set[str]:
    return {name for name, row in rows(made).items() if not row.ok}


def test_an_hour_without_trouble() -> None:
    made = rows(figures())
    assert len(made) == 5
    assert all(row.ok for row in made.values())
    told = as_json(made.values(), {})["rows"]
    assert [len(row["series"]["hours"]) for row in told if "series" in row] == [60]


@pytest.mark.parametrize(
    ("name", "change", "row"),
    [
        ("memory_mb", 1.03, "memory of the tracker"),
        ("recorder_memory_mb", 1.03, "memory of the recorder"),
        ("lag_median_s", 1.5, "latency of the last quarter"),
    ],
)
def test_what_grows_after_the_start_is_seen(name: str, change: float, row: str) -> None:
    made = figures()
    for sample in made["samples"][:3]:
        sample[name] /= 2.0  # what grows at the start does not count
    assert not bad(made)
    for sample in made["samples"][40:]:
        sample[name] *= change
    assert bad(made) == {row}


@pytest.mark.parametrize("more", [-1, 1])
@pytest.mark.parametrize("name", ["handled", "recorded_measurements", "recorded_odometry"])
def test_one_message_lost_or_of_others_is_seen(name: str, more: int) -> None:
    made = figures()
    made[name] += more
    assert bad(made) == {"messages not handled, or not in the recording"}


@pytest.mark.parametrize("name", ["missing", "not_finite"])
def test_one_bad_epoch_is_seen(name: str) -> None:
    made = figures()
    made["samples"][30][name] = 1
    assert bad(made) == {"epochs without an estimate, or with one that is not finite"}


def test_the_core_tracks_ten_devices_without_a_gap() -> None:
    (sample,) = day(1 / 6)
    assert (sample["missing"], sample["not_finite"]) == (0, 0)
    assert 0.5 < sample["largest_error_m"] < 15.0
    assert sample["epoch_s"] > 0.0
