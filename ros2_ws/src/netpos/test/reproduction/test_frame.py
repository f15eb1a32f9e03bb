"""The frame of reproductions: rows, verdicts, registry, seeds over processes."""

from __future__ import annotations

import math
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from netpos.evaluation.work import Work
from netpos.reproduction import frame
from netpos.reproduction.frame import (
    PAPERS,
    Outcome,
    Row,
    at_least,
    at_most,
    reproduce,
    required,
    shown,
)
from threadpoolctl import threadpool_info, threadpool_limits


@pytest.mark.parametrize(
    ("row", "ok"),
    [
        (at_most("a", "m", 0.4, 0.4), True),
        (at_most("a", "m", 0.41, 0.4), False),
        (at_most("a", "m", None, 0.4), False),
        (at_least("a", "1", 0.8, 0.8), True),
        (at_least("a", "1", 0.79, 0.8), False),
        (at_least("a", "1", None, 0.8), False),
        (shown("a", "m", 3.0), None),
        (required("a", "1", 0.0, True), True),
    ],
)
def test_verdict_of_a_row(row: Row, ok: bool | None) -> None:
    assert row.ok is ok


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_row_is_finite_or_none(value: float) -> None:
    with pytest.raises(ValueError, match="row 'a' must be finite or None"):
        shown("a", "m", value)


def _sum(offset: int, seeds: range) -> tuple[int, int]:
    return os.getpid(), sum(seeds) + offset


@pytest.mark.parametrize("workers", [1, 3])
def test_every_seed_is_run_once_and_in_order(workers: int) -> None:
    reports: list[tuple[str, int, int]] = []
    with Work(21, 5, workers, lambda *report: reports.append(report)) as work:
        results = work.over_seeds("sum", _sum, 1000)
    assert [total for _, total in results] == [
        1000 + sum(range(5, 13)),
        1000 + sum(range(13, 21)),
        1000 + sum(range(21, 26)),
    ]
    assert reports == [("sum", 8, 21), ("sum", 16, 21), ("sum", 21, 21)]
    assert (os.getpid() in {pid for pid, _ in results}) is (workers == 1)


def _threads(_: None, seeds: range) -> list[int]:
    return [int(library["num_threads"]) for library in threadpool_info()]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_process_computes_on_one_thread_while_there_is_work(workers: int) -> None:
    with threadpool_limits(2):
        before = _threads(None, range(0))
        assert 2 in before
        with Work(1, 1, workers) as work:
            assert work.over_seeds("threads", _threads, None) == [[1] * len(before)]
        assert _threads(None, range(0)) == before


def _paper(row: Row) -> SimpleNamespace:
    calls: list[str] = []

    def run(work: Work) -> Outcome:
        calls.append("reproduce")
        return Outcome(rows=(row,), draw=lambda folder: [folder / "a.png"])

    return SimpleNamespace(warm_up=lambda: calls.append("warm_up"), reproduce=run, calls=calls)


def test_result_has_the_agreed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    paper = _paper(at_most("error", "m", 0.3, 0.4).beside(baseline=0.5, defaults=0.6))
    monkeypatch.setitem(PAPERS, "some2026", "some.module")
    monkeypatch.setattr(frame, "import_module", {"some.module": paper}.__getitem__)
    result = reproduce("some2026", runs=7, seed=3, workers=1)
    assert paper.calls == ["warm_up", "reproduce"]
    content = result.to_json()
    assert 0 <= content.pop("wall_s") < 60
    assert content == {
        "paper": "some2026",
        "runs": 7,
        "seed": 3,
        "rows": [
            {
                "name": "error",
                "unit": "m",
                "paper": 0.4,
                "ours": 0.3,
                "ok": True,
                "baseline": 0.5,
                "defaults": 0.6,
            }
        ],
    }
    assert result.outcome.draw(Path("x")) == [Path("x/a.png")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"paper": "none1999"}, "no paper 'none1999'; known: .*fokin2020"),
        ({"runs": 0}, "runs must be at least 1, got 0"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"workers": 0}, "workers must be at least 1, got 0"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        reproduce(**{"paper": "fokin2020", **arguments})  # type: ignore[arg-type]


def test_fewer_runs_of_the_same_work() -> None:
    with Work(21, 5, 1) as work:
        few = work.with_runs(3)
        assert [total for _, total in few.over_seeds("few", _sum, 0)] == [5 + 6 + 7]
        assert sum(total for _, total in work.over_seeds("all", _sum, 0)) == sum(range(5, 26))


def test_a_paper_may_name_its_number_of_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = Outcome(rows=(), draw=lambda folder: [])
    module = SimpleNamespace(RUNS=7, warm_up=lambda: None, reproduce=lambda work: outcome)
    monkeypatch.setitem(PAPERS, "some2026", "some.module")
    monkeypatch.setattr(frame, "import_module", lambda name: module)
    assert reproduce("some2026", workers=1).runs == 7
    assert reproduce("some2026", runs=2, workers=1).runs == 2
    del module.RUNS
    assert reproduce("some2026", workers=1).runs == 1000
