"""deng2022: stations' ranges and angles with a strapdown INS, open and blocked.

Tables 1 and 2, each cell over many drives. The paper couples loosely: least-squares fixes go into
the filter. Beside it is the tight coupling, in which every range and angle is an update of its
own, and the tight coupling of a vehicle that neither slips nor leaves the ground.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from netpos.evaluation.pictures import save
from netpos.evaluation.work import Work
from netpos.reproduction.deng2022 import car_drive
from netpos.reproduction.deng2022.blocked_drive import (
    ALL_ANGLES,
    DEFAULT,
    DEFAULT_VEHICLE,
    FIX,
    FIX_HEIGHT,
    LOOSE,
    LOOSE_DIAGONAL,
    LOOSE_FIXED,
    TIGHT,
    VEHICLE,
    Case,
    run,
)
from netpos.reproduction.deng2022.bounds import bounds, in_outages, mean_dilution
from netpos.reproduction.deng2022.pictures import drive_errors, outage_curves
from netpos.reproduction.deng2022.rows import (
    ABOUT_COLUMNS,
    AXES,
    Cell,
    Line,
    clock_cells,
    lost_tracks,
    nees_rows,
    outage_cells,
    rms_cells,
    table_line,
    troubles,
)
from netpos.reproduction.deng2022.tally import NO_DRIVE, Tally, added, over_seeds
from netpos.reproduction.frame import Outcome, Row, at_least, at_most, required, shown

RUNS = 100
"""Drives of each case where the caller asks for no other number."""

OPEN_TOA = Case(name="4-8 stations, TOA", quantities=("range",), fewest=4, nearest=8)
OPEN = Case(name="4-8 stations, TOA/AOD", quantities=ALL_ANGLES, fewest=4, nearest=8)
BLOCKED = Case(name="1-2 stations, TOA/AOD", quantities=ALL_ANGLES, fewest=1, nearest=2)
OUTAGES, LONG_OUTAGES = (
    Case(
        name=f"{seconds} s outages, 4-8 stations",
        quantities=ALL_ANGLES,
        fewest=4,
        nearest=8,
        outage_s=seconds,
    )
    for seconds in (10, 30)
)
ONE_WAY = Case(
    name="1-2 stations, one-way TOA/AOD, clock unknown",
    quantities=("azimuth", "elevation", "toa"),
    fewest=1,
    nearest=2,
)

# Tables 1 and 2: least squares and, loosely coupled, with SINS.
TABLES: tuple[tuple[Case, Cell, Cell], ...] = (
    (OPEN_TOA, (91.3, 0.62, 0.79, 6.42), (100.0, 0.39, 0.48, 6.43)),
    (OPEN, (100.0, 0.64, 0.67, 1.15), (100.0, 0.38, 0.36, 0.44)),
    (BLOCKED, (98.1, 3.30, 3.44, 1.68), (100.0, 0.88, 0.97, 0.46)),
)
TIGHT_OVER_LOOSE_MAX = 0.7
OUTAGE_LIMIT_M = 2.0
REAL_OUTAGE_LIMIT_M = 2.0
"""Below the 2.56 m of a crude coast from the last RTK position, velocity and course."""
PAPER_DILUTION = (1.0, 3.0)
"""Mean horizontal and vertical dilution of precision among 4 to 8 stations (section 3.1)."""
BLOCKED_LIMIT_M = 1.0
"""Section 3.2: with SINS the blocked position is better than 1 m."""
_COUPLINGS = (LOOSE, TIGHT, VEHICLE)
_HELD = {TIGHT: "IMU alone", VEHICLE: "IMU and vehicle constraints"}


def warm_up() -> None:
    """Compile, or load, every kernel, and read the real drive, for the workers to inherit."""
    run(BLOCKED, 0)
    car_drive.recording()


def reproduce(work: Work) -> Outcome:
    """All rows, and pictures of the drive with the first seed."""
    tallies = {case: over_seeds(work, case) for case, _, _ in TABLES}
    rows = [
        *(row for case, fix, ins in TABLES for row in _table(case, tallies[case], fix, ins)),
        *(row for case, fix, ins in TABLES for row in _gains(case, tallies[case], fix, ins)),
        *_blocked(tallies[BLOCKED]),
        *_geometry(work),
        *_outages(OUTAGES, over_seeds(work, OUTAGES)),
        *_outages(LONG_OUTAGES, over_seeds(work, LONG_OUTAGES)),
        *_bounds(work, tallies[BLOCKED]),
        *_smoothed(work),
        *_one_way(over_seeds(work, ONE_WAY)),
        *_real(work),
    ]
    absent = f"no recording {car_drive.RECORDING}: set NETPOS_DATA; its rows are empty"
    notes = (ABOUT_COLUMNS,) if car_drive.recording() is not None else (ABOUT_COLUMNS, absent)
    return Outcome(rows=tuple(rows), draw=partial(_draw, work.seed), notes=notes)


def _table(case: Case, tallies: dict[str, Tally], fix: Cell, ins: Cell) -> Iterator[Row]:
    for variant in (FIX, FIX_HEIGHT):
        yield from table_line(Line.of(tallies, variant), f"{case.name}, {variant}", fix)
    for variant in _COUPLINGS:
        label = f"{case.name}, SINS, {variant}"
        yield from table_line(Line.of(tallies, variant), label, ins)
        yield _lost(Line.of(tallies, variant), label)
        if variant != LOOSE:
            what = {3: "position", 9: "position, velocity, attitude"}
            yield from nees_rows(Line.of(tallies, variant), label, variant, what)
    label = f"{case.name}, SINS, {DEFAULT_VEHICLE}"
    yield from table_line(Line.of(tallies, DEFAULT_VEHICLE), label, ins, judged=False)
    yield from Line.of(tallies, DEFAULT_VEHICLE).shown(label, "%", lost_tracks)


def _lost(line: Line, label: str) -> Row:
    """SINS loses no track, by the paper's text."""
    lost = line.ours.lost_percent
    row = required(f"{label}: lost tracks", "%", lost, lost == 0.0)
    return line.beside(row, lost_tracks, "lost tracks")


def _gains(case: Case, tallies: dict[str, Tally], fix: Cell, ins: Cell) -> Iterator[Row]:
    """By how much SINS lowers the RMS of least squares: the paper's text says about 40 % of the
    horizontal RMS in the open, 70 % of all where blocked; the limits are those of its tables."""
    plane = 100.0 * (1.0 - np.hypot(*ins[1:3]) / np.hypot(*fix[1:3]))
    down = 100.0 * (1.0 - ins[3] / fix[3])

    def lowered(tally: Tally) -> dict[str, float]:
        single = tallies[FIX]
        return {
            "horizontal": 100.0 * (1.0 - tally.plane_m / single.plane_m),
            "vertical": 100.0 * (1.0 - tally.rms_m[2] / single.rms_m[2]),
        }

    limits = {"horizontal": float(plane), "vertical": down}
    for variant in _COUPLINGS:
        line, label = Line.of(tallies, variant), f"{case.name}, SINS, {variant}"
        for key, ours in lowered(line.ours).items():
            if case == OPEN_TOA and key == "vertical":
                continue  # which the paper's SINS does not lower
            name = f"{label}: {key} RMS below that of least squares"
            yield line.beside(at_least(name, "%", ours, limits[key]), lowered, key)


def _largest_rms(tally: Tally) -> dict[str, float]:
    return {"largest RMS of an axis": max(tally.rms_m)}


def _geometry(work: Work) -> Iterator[Row]:
    """Dilution of precision, which no filter changes."""
    for what, ours, paper in zip(
        ("horizontal", "vertical"), mean_dilution(work, OPEN_TOA), PAPER_DILUTION, strict=True
    ):
        yield shown(f"{OPEN_TOA.name}: mean {what} dilution of precision", "1", ours, paper)


def _blocked(tallies: dict[str, Tally]) -> Iterator[Row]:
    """Claims of the paper about SINS where stations are blocked; the horizontal RMS of the tight
    over that of the loose coupling, ours and the paper's."""
    for variant in _COUPLINGS:
        line, label = Line.of(tallies, variant), f"{BLOCKED.name}, SINS, {variant}"
        yield from line.at_most(label, "m", _largest_rms, BLOCKED_LIMIT_M)
        ratio = float(line.ours.worst_m.max() / tallies[FIX].worst_m.max())
        yield required(f"{label}: largest error over that of least squares", "1", ratio, ratio < 1)
    paper = float(np.hypot(*TABLES[2][2][1:3]))
    for variant in (TIGHT, VEHICLE):
        for what, loose in (
            ("our loose", tallies[LOOSE].plane_m),
            ("the paper's loose", paper),
            (f"our {LOOSE_DIAGONAL}", tallies[LOOSE_DIAGONAL].plane_m),
            (f"our {LOOSE_FIXED}", tallies[LOOSE_FIXED].plane_m),
        ):
            ratio = tallies[variant].plane_m / loose
            label = f"Blocked, horizontal RMS, {variant}, over {what}"
            yield required(label, "1", ratio, ratio <= TIGHT_OVER_LOOSE_MAX)


def _outages(case: Case, tallies: dict[str, Tally]) -> Iterator[Row]:
    """Errors at the end of the outages: predictions, just before a measurement is used again."""
    for variant in _COUPLINGS:
        line = Line.of(tallies, variant)
        label = f"After {case.outage_s} s without any station, SINS, {variant}"
        if case == OUTAGES:
            yield from line.at_most(label, "m", outage_cells, OUTAGE_LIMIT_M)
        else:
            yield from line.shown(label, "m", outage_cells)
        yield from line.shown(f"{case.name}, SINS, {variant}", "%", troubles)


def _bounds(work: Work, blocked: dict[str, Tally]) -> Iterator[Row]:
    """The posterior Cramér-Rao bound of what misses its target."""
    loose = blocked[LOOSE].plane_m
    for case in (OPEN, BLOCKED, OUTAGES, LONG_OUTAGES):
        for variant, bound in bounds(work, case).items():
            label = f"Bound, {case.name}, SINS, {variant}"
            for axis, ours in zip(AXES, bound.rms_m.tolist(), strict=True):
                yield shown(f"{label}: RMS {axis}", "m", ours)
            plane = float(np.hypot(*bound.rms_m[:2]))
            if case == BLOCKED:
                yield shown(f"{label}: horizontal RMS over our loose", "1", plane / loose)
            if case.outage_s:
                end = float(np.hypot(*bound.end_rms_m[:2]))
                yield shown(f"{label}: after {case.outage_s} s, RMS, horizontal", "m", end)


def _smoothed(work: Work) -> Iterator[Row]:
    """Errors inside the outages, filtered and smoothed."""
    for case in (OUTAGES, LONG_OUTAGES):
        for variant, smoothed in in_outages(work, case).items():
            plane = float(np.hypot(*smoothed.rms_m[:2]))
            yield shown(f"Inside {case.name}, SINS, {variant}: RMS, horizontal", "m", plane)


def _one_way(tallies: dict[str, Tally]) -> Iterator[Row]:
    """Times of arrival by a clock with an unknown offset at the start."""
    for variant in (TIGHT, VEHICLE):
        line, label = Line.of(tallies, variant), f"{ONE_WAY.name}, SINS, {variant}"
        yield from line.shown(label, "m", rms_cells)
        yield from line.shown(label, "ns", clock_cells)
        yield from line.shown(label, "%", troubles)
        yield from nees_rows(line, label, variant, {3: "position", 1: "clock offset"})


def _real(work: Work) -> Iterator[Row]:
    """The real drive; every figure is None where the recording is absent."""
    there = car_drive.recording() is not None
    few = work.with_runs(min(work.runs, car_drive.SEEDS))
    for case in (OPEN, BLOCKED):
        label = f"real IMU, {case.name}"
        parts = few.over_seeds(label, car_drive.station_seeds, case) if there else []
        tallies = added(parts) if parts else {}
        for variant in _COUPLINGS:
            name = f"Real IMU, {case.name}, SINS, {variant}"
            for unit, cells in (("m", rms_cells), ("%", troubles)):
                if tallies:
                    yield from Line.of(tallies, variant).shown(name, unit, cells)
                else:
                    yield from (shown(f"{name}: {key}", unit, None) for key in cells(NO_DRIVE))
    coasts = {v: car_drive.outages(v) if there else None for v in (*_HELD, DEFAULT)}
    for variant, what in _HELD.items():
        for seconds, limit in ((10.0, REAL_OUTAGE_LIMIT_M), (30.0, None)):
            ours, unset = _median(coasts[variant], seconds), _median(coasts[DEFAULT], seconds)
            label = f"Real, {seconds:.0f} s without RTK, {what}: median horizontal error"
            row = shown(label, "m", ours) if limit is None else at_most(label, "m", ours, limit)
            yield row.beside(defaults=unset)


def _median(coasts: car_drive.Outages | None, seconds: float) -> float | None:
    return None if coasts is None else float(np.median(coasts.at(seconds)))


def _draw(seed: int, folder: Path) -> list[Path]:
    paths = []
    if car_drive.recording() is not None:
        path = folder / "real_outages.png"
        save(outage_curves({what: car_drive.outages(v) for v, what in _HELD.items()}), path)
        paths.append(path)
    for name, cases in {"fig3_open": (OPEN_TOA, OPEN), "fig4_blocked": (BLOCKED,)}.items():
        path = folder / f"{name}.png"
        save(drive_errors([(case.name, run(case, seed)) for case in cases]), path)
        paths.append(path)
    return paths
