"""What the replay, memory and route rows count; never how fast they are."""

from __future__ import annotations

import importlib
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from unittest import mock

import pytest
from netpos.bags import BagReader
from netpos.bench import memory, replay, routes
from netpos.bench.common import Row, Unavailable
from netpos.messages import topics
from netpos.scenario import load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos.scenario.replay import replay_bag
from netpos.tracking import Tracker


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bench") / "bag"
    simulate_to_bag(load_scenario("fast_pass"), path)
    return path


def test_reading_and_tracking_is_a_replay_that_writes_nothing(bag: Path, tmp_path: Path) -> None:
    summary = replay_bag(bag, tmp_path / "out")
    assert replay.read_and_track(bag) == summary.epochs > 0


def test_rosbags_decodes_what_the_tracker_takes(bag: Path) -> None:
    with BagReader(bag) as reader:
        names = (topics.RSU_INFO, topics.RSU_MEASUREMENTS)
        expected = sum(reader.topics[name].count for name in names)
    assert replay.read_and_decode(bag, replay.consumed_topics(bag)) == expected


def test_replay_rows_say_what_is_in_them() -> None:
    rows = [row for row in replay.replay_rows(quick=True) if isinstance(row, Row)]
    assert [(row.relation, row.target) for row in rows] == [(">=", 300), (">=", 300), ("<=", 2)]
    assert "Copies all" in rows[0].note
    assert "Neither writes" in rows[2].note


def test_the_fed_tracker_answers_every_epoch_after_its_first_fix() -> None:
    tracker = Tracker()
    for rsu in memory._RSUS:
        tracker.add_rsu(rsu)
    assert memory.feed(tracker, 0, 100) > 50
    assert memory.feed(tracker, 100, 200) == 100
    assert tracker.rejected()["vue_1"].total() == 0


def test_memory_is_compared_with_that_after_a_tenth(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = iter([100_000_000, 103_000_000])
    fed: list[tuple[int, int]] = []
    monkeypatch.setattr(memory, "resident_bytes", lambda: next(sizes))
    monkeypatch.setattr(memory, "feed", lambda _, start, stop: fed.append((start, stop)) or 0)
    (row,) = memory.memory_rows(quick=False)
    assert fed == [(0, 3600), (3600, 36000)]
    assert isinstance(row, Row)
    assert row.ratio == pytest.approx(1.03)
    assert not row.ok


def test_resident_memory_is_of_the_order_of_a_process() -> None:
    try:
        size = memory.resident_bytes()
    except Unavailable as reason:
        pytest.skip(str(reason))
    assert 1e7 < size < 1e10


def test_route_rows_scale_the_limit_and_fit_the_growth(monkeypatch: pytest.MonkeyPatch) -> None:
    class Here:
        """A pool of this process: (16, 32, 64) routes in 1, 2, 4 s."""

        def __init__(self, *_: object, **__: object) -> None: ...
        def __enter__(self) -> Here:
            return self

        def __exit__(self, *_: object) -> None: ...
        def submit(self, _: object, counts: tuple[int, ...]) -> Here:
            assert counts in ((1,), (16, 32, 64))
            return self

        def result(self) -> tuple[list[float], float]:
            return [1.0, 2.0, 4.0], 2.0**29

    monkeypatch.setattr(routes, "ProcessPoolExecutor", Here)
    duration, memory_row, exponent = routes.route_rows(quick=True)
    ratios = [row.ratio for row in (duration, memory_row, exponent) if isinstance(row, Row)]
    assert ratios == pytest.approx([4.0 / (20.0 * 0.064), 0.5, 1.0])


def peaks_with_and_without_memory(size: int) -> tuple[float, float]:
    """What ``run_routes`` counts if a worker does nothing, and if it holds ``size`` bytes."""
    held = [0, size]

    def work_in_a_child(*_: object) -> None:
        child = multiprocessing.get_context("fork").Process(target=bytearray, args=(held.pop(0),))
        child.start()
        child.join()

    module = importlib.import_module("netpos.reproduction.monte_carlo")
    with (
        mock.patch.object(module, "monte_carlo", work_in_a_child),
        mock.patch("netpos.reproduction.fokin2020.paper.warm_up"),
    ):
        return routes.run_routes((1,))[1], routes.run_routes((1,))[1]


def test_the_memory_of_each_worker_is_counted() -> None:
    fresh = multiprocessing.get_context("spawn")  # the peak counts all a process did before
    with ProcessPoolExecutor(1, mp_context=fresh) as pool:
        before, after = pool.submit(peaks_with_and_without_memory, 300_000_000).result()
    assert after - before == pytest.approx(2 * 300e6, rel=0.05)


def test_routes_are_run_in_a_fresh_process() -> None:
    seconds, size = routes.routes_in_fresh_process((1, 2))
    assert len(seconds) == 2
    assert min(seconds) > 0.0
    assert size > 5e7
