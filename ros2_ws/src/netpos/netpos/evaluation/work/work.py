"""Seeds to run, and the executor that runs them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence, Sized
from copy import copy
from types import TracebackType
from typing import Self, TypeVar

from threadpoolctl import threadpool_limits

from netpos.evaluation.work.executors import Cluster, Executor, Here, Processes
from netpos.evaluation.work.kept import Kept

# Seeds per job. A constant, so that sums over a job do not depend on the number of workers.
SEEDS_PER_JOB = 8

Argument = TypeVar("Argument")
Part = TypeVar("Part", bound=Sized)
Result = TypeVar("Result")
Progress = Callable[[str, int, int], None]
"""Called with a label, what is done and what there is in all."""


class Work:
    """Seeds to run and their executor; a context manager.

    Every job computes on one thread: the threads of a linear algebra library would wait for each
    other in loops, and results would depend on their number.
    """

    def __init__(
        self,
        runs: int,
        seed: int,
        workers: int | None = None,
        progress: Progress | None = None,
        *,
        cluster: str | None = None,
        kept: Kept | None = None,
        apart: bool = False,
    ) -> None:
        """``workers``: processes, None: one per processor, 1: this process, or with ``apart`` one
        of its own, so that nothing interrupts compiled code. ``cluster``: address of a Ray cluster
        in their place. ``kept``: finished jobs are kept there and not run again.

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
        self._workers = workers
        self._apart = apart
        self._cluster = cluster
        self._progress = progress
        self._kept = kept
        self._executor: Executor = Here()

    def __enter__(self) -> Self:
        self._threads = threadpool_limits(1)  # which forked processes inherit
        if self._cluster is not None:
            self._executor = Cluster(self._cluster)
        elif self._workers > 1 or self._apart:
            self._executor = Processes(self._workers)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._executor.close(abandon=kind is not None)
        self._executor = Here()
        self._threads.restore_original_limits()

    def with_runs(self, runs: int) -> Work:
        """The same work and executor for another number of runs."""
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
        return list(self.over(label, job, argument, parts))

    def over(
        self,
        label: str,
        job: Callable[[Argument, Part], Result],
        argument: Argument,
        parts: Sequence[Part],
    ) -> Iterator[Result]:
        """``job(argument, part)`` for each part, results in the order of the parts; progress
        counts what is in them. A job is a function of a module, its arguments can be pickled."""
        waits = [self._begun(job, argument, part) for part in parts]
        done, total = 0, sum(map(len, parts))
        for part, wait in zip(parts, waits, strict=True):
            yield wait()
            done += len(part)
            if self._progress is not None:
                self._progress(label, done, total)

    def _begun(
        self, job: Callable[[Argument, Part], Result], argument: Argument, part: Part
    ) -> Callable[[], Result]:
        def submit() -> Callable[[], Result]:
            return self._executor.submit(job, argument, part)

        if self._kept is None:
            return submit()
        return self._kept.through(submit, job, argument, part)
