"""Jobs give the same results wherever they run, and lose nothing that was finished."""

from __future__ import annotations

import math
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.evaluation.work import Kept, Work, WorkerDiedError


def draw(scale: float, seeds: range) -> list[float]:
    """Sums whose last bits depend on the order, and on threads if there were any."""
    values = []
    for seed in seeds:
        a = np.random.default_rng(seed).normal(size=(60, 60))
        values.append(scale * float(np.linalg.inv(a @ a.T).sum()))
    return values


def note(folder: Path, part: tuple[int, ...]) -> int:
    """Leaves a mark for every time it is run."""
    mark = folder / f"{part[0]}"
    mark.write_text(mark.read_text() + "x" if mark.exists() else "x")
    return part[0] ** 2


def die_once(folder: Path, part: tuple[int, ...]) -> int:
    """Its first run for part 2 is killed from outside, as by the machine's memory guard."""
    mark = folder / "died"
    if part[0] == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return part[0]


def refuse(_: None, part: tuple[int, ...]) -> int:
    raise ValueError(f"part {part[0]} is wrong")


PARTS = [(k,) for k in range(6)]


@pytest.fixture(scope="module")
def serial() -> list[list[float]]:
    with Work(20, 5, 1) as work:
        return work.over_seeds("drawn", draw, math.pi)


def test_processes_give_the_same_bits(serial: list[list[float]]) -> None:
    for workers in (2, 3):
        with Work(20, 5, workers) as work:
            assert work.over_seeds("drawn", draw, math.pi) == serial


def test_progress_counts_what_is_in_the_parts() -> None:
    reports: list[tuple[str, int, int]] = []
    with Work(20, 0, 1, lambda *report: reports.append(report)) as work:
        work.over_seeds("drawn", draw, 1.0)
    assert reports == [("drawn", 8, 20), ("drawn", 16, 20), ("drawn", 20, 20)]


def test_a_dead_process_is_an_error_of_its_own(tmp_path: Path) -> None:
    with Work(1, 0, 2) as work, pytest.raises(WorkerDiedError, match="died"):
        list(work.over("parts", die_once, tmp_path, PARTS))


class TestKept:
    def test_finished_jobs_are_not_run_again(self, tmp_path: Path) -> None:
        marks = tmp_path / "marks"
        marks.mkdir()
        for _ in range(2):
            with Work(1, 0, 1, kept=Kept(tmp_path / "kept")) as work:
                assert list(work.over("p", note, marks, PARTS)) == [k**2 for k in range(6)]
        assert [(marks / str(k)).read_text() for k in range(6)] == ["x"] * 6

    def test_interrupted_work_goes_on(self, tmp_path: Path) -> None:
        kept = Kept(tmp_path / "kept")
        with (
            Work(1, 0, 1, kept=kept) as work,
            pytest.raises(ValueError, match="part 0"),
        ):
            list(work.over("p", refuse, None, PARTS))
        marks = tmp_path / "marks"
        marks.mkdir()
        with Work(1, 0, 1, kept=kept) as work:
            several = work.over("p", note, marks, PARTS)
            assert [next(several), next(several)] == [0, 1]
        with Work(1, 0, 2, kept=kept) as work:
            assert list(work.over("p", note, marks, PARTS)) == [k**2 for k in range(6)]
        assert [(marks / str(k)).read_text() for k in range(6)] == ["x"] * 6

    def test_another_argument_is_another_job(self, tmp_path: Path) -> None:
        kept = Kept(tmp_path / "kept")
        results = []
        for scale in (1.0, 2.0):
            with Work(2, 0, 1, kept=kept) as work:
                results.append(work.over_seeds("drawn", draw, scale)[0][0])
        assert results[1] == 2 * results[0]

    def test_a_file_is_no_folder(self, tmp_path: Path) -> None:
        (tmp_path / "a").touch()
        with pytest.raises(NotADirectoryError, match="is a file"):
            Kept(tmp_path / "a")


@pytest.fixture(scope="module")
def address() -> str:
    pytest.importorskip("ray", reason="Ray is not installed")
    return "local"


class TestCluster:
    """A Ray cluster on this machine."""

    def test_it_gives_the_same_bits_as_one_process(
        self, address: str, serial: list[list[float]]
    ) -> None:
        reports: list[Any] = []
        with Work(20, 5, cluster=address, progress=lambda *report: reports.append(report)) as work:
            assert work.over_seeds("drawn", draw, math.pi) == serial
        assert reports[-1] == ("drawn", 20, 20)

    def test_a_killed_worker_loses_nothing(self, address: str, tmp_path: Path) -> None:
        with Work(1, 0, cluster=address) as work:
            assert list(work.over("parts", die_once, tmp_path, PARTS)) == [*range(6)]
        assert (tmp_path / "died").exists()

    def test_an_error_of_a_job_comes_back(self, address: str) -> None:
        with Work(1, 0, cluster=address) as work, pytest.raises(ValueError, match="is wrong"):
            list(work.over("parts", refuse, None, PARTS))

    def test_nobody_there_is_one_sentence(self, address: str) -> None:
        with pytest.raises(ValueError, match="no Ray cluster at"), Work(1, 0, cluster="auto"):
            pass
