"""Rows of deng2022's drives: a figure of a variant beside the paper's filter and the defaults."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from netpos.reproduction.deng2022.blocked_drive import (
    DEFAULT,
    FIX,
    FIX_HEIGHT,
    LOOSE,
    TIGHT,
    VEHICLE,
)
from netpos.reproduction.deng2022.tally import LARGE_ERROR_M, Tally
from netpos.reproduction.frame import Row, at_least, at_most, required, shown

Cell = tuple[float, float, float, float]
"""Success [%] and RMS north, east, down [m]."""
Figures = Callable[[Tally], Mapping[str, float]]

AXES = ("north", "east", "down")
# Which variant is the paper's own for a variant, and which has the library's defaults.
_PAPERS = {FIX: FIX, FIX_HEIGHT: FIX}
_DEFAULTS = {TIGHT: DEFAULT, VEHICLE: DEFAULT}
_ONE_SIDED = "at most {}, since the simulated car keeps its constraints exactly"
ABOUT_COLUMNS = (
    "paper's filter: least squares, or the loose coupling with the covariance of each fix."
    " defaults: tight coupling with motion_model strapdown and nothing else set (noise of the IMU"
    " and the clock, no vehicle constraints). On a simulated drive all filters start from one"
    " state, whose error is drawn from the start covariance of the paper's filter."
)


@dataclass(frozen=True, slots=True)
class Line:
    """A variant of a case: its tally, that of the paper's own filter and that with defaults."""

    ours: Tally
    baseline: Tally | None
    defaults: Tally | None

    @classmethod
    def of(cls, tallies: Mapping[str, Tally], variant: str) -> Line:
        """From the tallies of a case; a figure without a tally stays empty."""
        paper = tallies.get(_PAPERS.get(variant, LOOSE))
        return cls(tallies[variant], paper, tallies.get(_DEFAULTS.get(variant, "")))

    def beside(self, row: Row, figures: Figures, key: str) -> Row:
        """The row with the same figure of the other two."""
        values = [None if t is None else figures(t)[key] for t in (self.baseline, self.defaults)]
        return row.beside(*values)

    def shown(self, label: str, unit: str, figures: Figures) -> Iterator[Row]:
        """A row without a target for each of the figures."""
        for key, ours in figures(self.ours).items():
            yield self.beside(shown(f"{label}: {key}", unit, ours), figures, key)

    def at_most(self, label: str, unit: str, figures: Figures, limit: float) -> Iterator[Row]:
        """A row with one target for each of the figures."""
        for key, ours in figures(self.ours).items():
            yield self.beside(at_most(f"{label}: {key}", unit, ours, limit), figures, key)


def rms_cells(tally: Tally) -> dict[str, float]:
    """RMS of the axes [m]."""
    return {f"RMS {axis}": rms for axis, rms in zip(AXES, tally.rms_m, strict=True)}


def lost_tracks(tally: Tally) -> dict[str, float]:
    """Share of drives [%]."""
    return {"lost tracks": tally.lost_percent}


def unscored(tally: Tally) -> dict[str, float]:
    """Shares that a mean hides [%]."""
    return {
        "time not scored": 100.0 - tally.success_percent,
        f"drives with a 3-D error above {LARGE_ERROR_M:.0f} m": tally.large_percent,
    }


def troubles(tally: Tally) -> dict[str, float]:
    """The same of a track, which may be lost [%]."""
    return {**lost_tracks(tally), **unscored(tally)}


def clock_cells(tally: Tally) -> dict[str, float]:
    """Offset of the clock [ns]."""
    error, stated = tally.clock_ns
    return {"RMS clock offset": error, "clock offset sd as stated": stated}


def outage_cells(tally: Tally) -> dict[str, float]:
    """Errors at the end of the outages [m]."""
    rms = np.sqrt(np.mean(tally.outage_m**2, axis=0)).tolist()
    median = np.median(tally.outage_m, axis=0).tolist()
    return {"RMS, horizontal": rms[0], "RMS, 3-D": rms[1], "median, 3-D": median[1]}


def _success(tally: Tally) -> dict[str, float]:
    return {"success": tally.success_percent}


def table_line(line: Line, label: str, paper: Cell, *, judged: bool = True) -> Iterator[Row]:
    """The cells of one line of a table, and what its RMS hides."""
    reach, stay = (at_least, at_most) if judged else (shown, shown)
    success = reach(f"{label}: success", "%", line.ours.success_percent, paper[0])
    yield line.beside(success, _success, "success")
    for (key, ours), limit in zip(rms_cells(line.ours).items(), paper[1:], strict=True):
        yield line.beside(stay(f"{label}: {key}", "m", ours, limit), rms_cells, key)
    yield from line.shown(label, "%", unscored)


def nees_rows(line: Line, label: str, variant: str, states: Mapping[int, str]) -> Iterator[Row]:
    """Mean NEES, two-sided; one-sided with constraints that the simulated car keeps exactly: their
    sd holds what real cars do."""
    for dof, what in states.items():
        test, careful = line.ours.nees_test(dof), variant == VEHICLE
        expected = _ONE_SIDED.format(dof) if careful else f"expected {dof}"
        name = f"{label}: NEES of {what} ({expected})"
        ok = test.mean <= test.bounds[1] if careful else test.consistent
        others = [
            None if t is None else t.nees_test(dof).mean for t in (line.baseline, line.defaults)
        ]
        yield required(name, "1", test.mean, ok).beside(*others)
        if not careful:
            yield shown(f"{name}, lower 95 % bound", "1", test.bounds[0])
        yield shown(f"{name}, upper 95 % bound", "1", test.bounds[1])
