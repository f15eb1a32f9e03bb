"""Rows of the benchmark and how an operation is timed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One ratio of what was measured to a reference measured beside it (or to a stated limit).

    ``ours`` and ``reference_value`` are in ``unit``; ``ratio`` is how ``relation`` to ``target``
    is read. ``series``: values over time behind it, by name.
    """

    name: str
    ours: float
    unit: str
    reference: str
    reference_value: float
    ratio: float
    relation: Literal[">=", "<="]
    target: float
    note: str = ""
    series: Mapping[str, Sequence[float]] | None = None

    @property
    def ok(self) -> bool:
        """Whether the ratio meets its target; never where it is not a number."""
        return self.ratio >= self.target if self.relation == ">=" else self.ratio <= self.target


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A row that could not be measured here, with the reason as a sentence."""

    name: str
    reason: str


Result = Row | LeftOut


class Unavailable(RuntimeError):  # noqa: N818 - not an error of the program
    """A tool that a row needs is missing; the message names it in a sentence."""


def faster(
    name: str, ours: float, reference: str, reference_value: float, target: float, note: str = ""
) -> Row:
    """Row of a speed-up: how many times longer the reference takes, at least ``target``."""
    return Row(
        name=name,
        ours=ours,
        unit="s",
        reference=reference,
        reference_value=reference_value,
        ratio=reference_value / ours,
        relation=">=",
        target=target,
        note=note,
    )


def within(
    name: str,
    ours: float,
    reference: str,
    reference_value: float,
    target: float,
    unit: str = "s",
    note: str = "",
) -> Row:
    """Row of a cost: how many times the reference, at most ``target``."""
    return Row(
        name=name,
        ours=ours,
        unit=unit,
        reference=reference,
        reference_value=reference_value,
        ratio=ours / reference_value,
        relation="<=",
        target=target,
        note=note,
    )


def side_by_side(
    operations: Mapping[str, tuple[Callable[[], object], int]], rounds: int
) -> dict[str, float]:
    """Seconds per operation of each, the best of ``rounds`` in which they take turns: what the
    code costs when nothing interferes.

    operations : by name, a call and how many operations happen in it. Calls should last about
        equally long, for a long one is interrupted more often than a short one. The first call of
        each is not timed.
    """
    best = dict.fromkeys(operations, math.inf)
    for call, _ in operations.values():
        call()
    for _ in range(rounds):
        for name, (call, count) in operations.items():
            start = time.perf_counter()
            call()
            best[name] = min(best[name], (time.perf_counter() - start) / count)
    return best


def growth_exponent(sizes: Iterable[float], costs: Iterable[float]) -> float:
    """Exponent b of the power law cost = a size^b, by least squares of the logarithms.

    Raises ``ValueError`` for a cost that is not > 0.
    """
    sizes, costs = np.array(list(sizes), dtype=float), np.array(list(costs), dtype=float)
    if not (costs > 0.0).all():
        raise ValueError(f"costs must be > 0 to fit an exponent, got {costs.tolist()}")
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def as_json(results: Iterable[Result], surroundings: Mapping[str, Any]) -> dict[str, Any]:
    """Rows and what was left out as plain values; ``surroundings`` says on what they were
    measured."""
    results = list(results)
    return {
        "surroundings": dict(surroundings),
        "rows": [_plain(row) for row in results if isinstance(row, Row)],
        "left_out": [asdict(row) for row in results if isinstance(row, LeftOut)],
    }


def _plain(row: Row) -> dict[str, Any]:
    values = {**asdict(row), "ok": row.ok}
    if row.series is None:
        del values["series"]
    return values
