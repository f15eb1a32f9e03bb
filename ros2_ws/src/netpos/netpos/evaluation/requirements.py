"""Verdicts against published requirements: fokin2020's priority passage (TSP) and the 3GPP V2X
accuracy sets (TR 38.845).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from netpos.evaluation.metrics import Figures
from netpos.messages.values import Array

TSP_SPEED_MPS = 42.0  # fokin2020 writes 150 km/h as 42 m/s
TSP_ERROR_M = 1.0

# (name, error [m] that the share [%] of estimates keeps): the least and the most the set asks for
V2X_SETS = (
    ("v2x_set_1", (50.0, 68), (10.0, 95)),
    ("v2x_set_2", (3.0, 95), (1.0, 99)),
    ("v2x_set_3", (0.5, 95), (0.1, 99)),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One requirement: ``ok`` is None where the run has no figure."""

    name: str
    required: str
    measured: float | None
    ok: bool | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A named set of requirements; ``ok`` follows the rows, or for the V2X sets the least
    demanding one.
    """

    name: str
    rows: tuple[Row, ...]
    ok: bool | None

    def to_json(self) -> dict[str, Any]:
        """Plain types."""
        return {"ok": self.ok, "rows": [asdict(row) for row in self.rows]}


def _at_most(name: str, required: str, measured: float | None, limit: float) -> Row:
    ok = None if measured is None else measured <= limit
    return Row(name=name, required=required, measured=measured, ok=ok)


def _all(rows: Sequence[Row]) -> bool | None:
    if any(row.ok is False for row in rows):
        return False
    return None if any(row.ok is None for row in rows) else True


def priority_passage(figures: Figures, errors: Array) -> Verdict:
    """fokin2020's requirements of Transit Signal Priority: rate, position, heading, readiness,
    speed.

    errors : (n,) horizontal errors [m] of the scored estimates. Position is judged by RMSE; the
    share of estimates within 1 m is shown and not judged. Speed is that of the run: the
    requirement holds for vehicles up to 42 m/s.
    """
    rate = figures.output_rate_hz
    ready = figures.initial.time_to_ready_s
    within = 100.0 * float(np.mean(errors <= TSP_ERROR_M)) if errors.size else None
    rows = (
        Row(
            name="output rate [Hz]",
            required=">= 5",
            measured=rate,
            ok=None if rate is None else rate >= 5.0,
        ),
        _at_most("position RMSE [m]", "<= 1", figures.rmse_m, TSP_ERROR_M),
        _at_most("heading RMSE [deg]", "<= 1", figures.heading_rmse_deg, 1.0),
        # a run that never got ready fails; it is not unknown
        Row(
            name="ready after [s]",
            required="<= 30",
            measured=ready,
            ok=ready is not None and ready <= 30.0,
        ),
        _at_most(
            "top speed of the run [m/s]", "<= 42 (150 km/h)", figures.speed_max_mps, TSP_SPEED_MPS
        ),
    )
    share = Row(name="within 1 m [% of estimates]", required="shown", measured=within, ok=None)
    return Verdict(name="tsp", rows=(*rows, share), ok=_all(rows))


def v2x_sets(errors: Array) -> tuple[Verdict, ...]:
    """3GPP V2X sets 1 to 3. Each set spans a range of demands; the two ends are the rows, and the
    less demanding one decides.
    """
    verdicts = []
    for name, *demands in V2X_SETS:
        rows = tuple(
            _at_most(
                f"error at {percent} % [m]",
                f"<= {limit:g}",
                float(np.percentile(errors, percent)) if errors.size else None,
                limit,
            )
            for limit, percent in demands
        )
        verdicts.append(Verdict(name=name, rows=rows, ok=rows[0].ok))
    return tuple(verdicts)


def judge(figures: Figures, errors: Array) -> tuple[Verdict, ...]:
    """All verdicts on one device's run; errors : (n,) horizontal errors [m] of the scored
    estimates.
    """
    return (priority_passage(figures, errors), *v2x_sets(errors))
