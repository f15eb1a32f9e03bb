"""The frame a paper's reproduction plugs into: rows against the paper, seeds over processes.

A paper is a module with ``warm_up()``, which compiles what the worker processes will inherit, and
``reproduce(work) -> Outcome``.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from copy import copy
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from threadpoolctl import threadpool_limits

PAPERS = {
    "fokin2020": "netpos.evaluation.reproduce.fokin2020",
    "dvornikov2017": "netpos.evaluation.reproduce.dvornikov2017",
    "deng2022": "netpos.evaluation.reproduce.deng2022",
    "petukhov": "netpos.evaluation.reproduce.petukhov",
}
"""Module of each paper by its name."""

DEFAULT_RUNS = 1000

# Seeds per job. A constant, so that sums over a job do not depend on the number of workers.
SEEDS_PER_JOB = 8

Argument = TypeVar("Argument")
Result = TypeVar("Result")
Progress = Callable[[str, int, int], None]
"""Called with a label, the seeds done and the seeds in all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One figure.

    paper: what the paper says. baseline: the paper's own filter on our simulation, with the same
    measurements. ours: netpos with the settings of the scenario. defaults: netpos with the motion,
    clock and start parameters of the library, as a user has who tunes nothing. Each is None where
    there is none or it cannot be computed. ok: whether ours keeps the target (None where there is
    no target).
    """

    name: str
    unit: str
    paper: float | None
    ours: float | None
    ok: bool | None
    baseline: float | None = None
    defaults: float | None = None

    def __post_init__(self) -> None:
        for value in (self.paper, self.baseline, self.ours, self.defaults):
            if value is not None and not math.isfinite(value):
                raise ValueError(f"row {self.name!r} must be finite or None, got {value}")

    def beside(self, baseline: float | None = None, defaults: float | None = None) -> Row:
        """The same row with the paper's own filter and the default settings beside it."""
        return replace(self, baseline=baseline, defaults=defaults)


def shown(name: str, unit: str, ours: float | None, paper: float | None = None) -> Row:
    """A figure without a target."""
    return Row(name=name, unit=unit, paper=paper, ours=ours, ok=None)


def at_most(name: str, unit: str, ours: float | None, limit: float) -> Row:
    """A figure that must not exceed the paper's; one that cannot be computed misses it."""
    return Row(name=name, unit=unit, paper=limit, ours=ours, ok=ours is not None and ours <= limit)


def at_least(name: str, unit: str, ours: float | None, limit: float) -> Row:
    """A figure that must reach the paper's; one that cannot be computed misses it."""
    return Row(name=name, unit=unit, paper=limit, ours=ours, ok=ours is not None and ours >= limit)


def required(name: str, unit: str, ours: float | None, ok: bool) -> Row:
    """A figure the paper does not give, with a requirement of our own."""
    return Row(name=name, unit=unit, paper=None, ours=ours, ok=ok)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What a paper's reproduction gives: rows, and a function that draws into a folder and returns
    the files it wrote; ``notes`` say what could not be run."""

    rows: tuple[Row, ...]
    draw: Callable[[Path], list[Path]]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Reproduction:
    """A finished reproduction."""

    paper: str
    runs: int
    seed: int
    wall_s: float
    outcome: Outcome

    @property
    def rows(self) -> tuple[Row, ...]:
        """The figures."""
        return self.outcome.rows

    def to_json(self) -> dict[str, Any]:
        """Plain types: paper, runs, seed, wall_s, rows."""
        return {
            "paper": self.paper,
            "runs": self.runs,
            "seed": self.seed,
            "wall_s": self.wall_s,
            "rows": [asdict(row) for row in self.rows],
        }


class Work:
    """Seeds to run and processes to run them on; a context manager.

    Processes are forked, so that they share the compiled kernels and start at once; ``workers`` 1
    runs in this process. Each computes on one thread: the threads of a linear algebra library
    would wait for each other in loops.
    """

    def __init__(
        self, runs: int, seed: int, workers: int | None = None, progress: Progress | None = None
    ) -> None:
        """``workers`` None: one per processor.

        Raises
        ------
        ValueError  runs or workers < 1, or seed < 0
        """
        workers = len(os.sched_getaffinity(0)) if workers is None else workers
        for name, value, low in (("runs", runs, 1), ("seed", seed, 0), ("workers", workers, 1)):
            if value < low:
                raise ValueError(f"{name} must be at least {low}, got {value}")
        self.runs = runs
        self.seed = seed
        self.workers = workers
        self._progress = progress
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        self._threads = threadpool_limits(1)  # which forked processes inherit
        if self.workers > 1:
            fork = multiprocessing.get_context("fork")
            self._pool = ProcessPoolExecutor(self.workers, mp_context=fork)
            self._pool.submit(int).result()  # fork now, before a progress display starts a thread
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None
        self._threads.restore_original_limits()

    def with_runs(self, runs: int) -> Work:
        """The same work and processes for another number of runs."""
        other = copy(self)
        other.runs = runs
        return other

    def over_seeds(
        self, label: str, job: Callable[[Argument, range], Result], argument: Argument
    ) -> list[Result]:
        """``job(argument, seeds)`` for all seeds, ``SEEDS_PER_JOB`` at a time; results in the
        order of the seeds. Run i has the seed ``seed + i``."""
        end = self.seed + self.runs
        parts = [
            range(first, min(first + SEEDS_PER_JOB, end))
            for first in range(self.seed, end, SEEDS_PER_JOB)
        ]
        results, done = [], 0
        for part, result in zip(parts, self._each(job, argument, parts), strict=True):
            results.append(result)
            done += len(part)
            if self._progress is not None:
                self._progress(label, done, self.runs)
        return results

    def _each(
        self, job: Callable[[Argument, range], Result], argument: Argument, parts: list[range]
    ) -> Iterator[Result]:
        if self._pool is None:
            return (job(argument, part) for part in parts)
        futures = [self._pool.submit(job, argument, part) for part in parts]
        return (future.result() for future in futures)


def reproduce(
    paper: str,
    *,
    runs: int | None = None,
    seed: int = 1,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Reproduction:
    """Reproduce a paper's figures; ``runs`` None: as many as its module's ``RUNS`` says, or 1000.

    Raises
    ------
    ValueError  unknown paper (the text lists the known ones), runs or workers < 1, seed < 0
    concurrent.futures.process.BrokenProcessPool  a worker process died
    """
    if paper not in PAPERS:
        raise ValueError(f"no paper {paper!r}; known: {', '.join(sorted(PAPERS))}")
    module = import_module(PAPERS[paper])
    runs = getattr(module, "RUNS", DEFAULT_RUNS) if runs is None else runs
    work = Work(runs, seed, workers, progress)
    module.warm_up()
    start = time.perf_counter()
    with work:
        outcome = module.reproduce(work)
    wall_s = round(time.perf_counter() - start, 3)
    return Reproduction(paper=paper, runs=runs, seed=seed, wall_s=wall_s, outcome=outcome)
