"""The frame a paper's reproduction plugs into: rows against the paper.

A paper is a module with ``warm_up()``, which compiles what the worker processes will inherit, and
``reproduce(work) -> Outcome``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from netpos.evaluation.work import Kept, Progress, Work

PAPERS = {
    "fokin2020": "netpos.reproduction.fokin2020.paper",
    "dvornikov2017": "netpos.reproduction.dvornikov2017.paper",
    "deng2022": "netpos.reproduction.deng2022.paper",
    "petukhov": "netpos.reproduction.petukhov.paper",
}
"""Module of each paper by its name."""

DEFAULT_RUNS = 1000


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


def reproduce(
    paper: str,
    *,
    runs: int | None = None,
    seed: int = 1,
    workers: int | None = None,
    progress: Progress | None = None,
    cluster: str | None = None,
    kept: Kept | None = None,
) -> Reproduction:
    """Reproduce a paper's figures; ``runs`` None: as many as its module's ``RUNS`` says, or 1000.
    The rest is that of ``Work``.

    Raises
    ------
    ValueError  unknown paper (the text lists the known ones), runs or workers < 1, seed < 0
    WorkerDiedError  a worker process died
    """
    if paper not in PAPERS:
        raise ValueError(f"no paper {paper!r}; known: {', '.join(sorted(PAPERS))}")
    module = import_module(PAPERS[paper])
    runs = getattr(module, "RUNS", DEFAULT_RUNS) if runs is None else runs
    work = Work(runs, seed, workers, progress, cluster=cluster, kept=kept, apart=True)
    module.warm_up()
    start = time.perf_counter()
    with work:
        outcome = module.reproduce(work)
    wall_s = round(time.perf_counter() - start, 3)
    return Reproduction(paper=paper, runs=runs, seed=seed, wall_s=wall_s, outcome=outcome)
