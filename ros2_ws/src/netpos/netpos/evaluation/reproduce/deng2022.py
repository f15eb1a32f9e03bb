"""deng2022: stations' ranges and angles with a strapdown INS, open and blocked.

Tables 1 and 2, each cell over many drives. The paper couples loosely: least-squares fixes go into
the filter. Beside it stand the tight coupling, in which every range and angle is an update of its
own, and the tight coupling of a vehicle that neither slips nor leaves the ground.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from netpos.evaluation.pictures import save
from netpos.evaluation.reproduce import car_drive
from netpos.evaluation.reproduce.blocked_drive import (
    ALL_ANGLES,
    FIX,
    FIX_HEIGHT,
    LOOSE,
    LOOSE_DIAGONAL,
    LOOSE_FIXED,
    TIGHT,
    VEHICLE,
    Case,
    Tally,
    over_seeds,
    run,
)
from netpos.evaluation.reproduce.drive_bounds import bounds, in_outages
from netpos.evaluation.reproduce.drive_pictures import drive_errors, outage_curves
from netpos.evaluation.reproduce.frame import (
    Outcome,
    Row,
    Work,
    at_least,
    at_most,
    required,
    shown,
)

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

Cell = tuple[float, float, float, float]
"""Success [%] and RMS north, east, down [m]."""

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
_AXES = ("north", "east", "down")
_HELD = {TIGHT: "IMU alone", VEHICLE: "IMU and vehicle constraints"}


def warm_up() -> None:
    """Compile, or load, every kernel, and read the real drive, for the workers to inherit."""
    run(BLOCKED, 0)
    car_drive.recording()


def reproduce(work: Work) -> Outcome:
    """All rows, and pictures of the drive with the first seed."""
    tallies = {case: over_seeds(work, case) for case, _, _ in TABLES}
    outages = over_seeds(work, OUTAGES)
    rows = [
        *(row for case, fix, ins in TABLES for row in _table(case, tallies[case], fix, ins)),
        *_blocked(tallies[BLOCKED]),
        *_outages(outages),
        *_bounds(work, tallies[BLOCKED]),
        *_smoothed(work),
        *_one_way(over_seeds(work, ONE_WAY)),
        *_real(work),
    ]
    absent = f"no recording {car_drive.RECORDING}: set NETPOS_DATA; its rows are empty"
    notes = () if car_drive.recording() is not None else (absent,)
    return Outcome(rows=tuple(rows), draw=partial(_draw, work.seed), notes=notes)


def _cells(name: str, tally: Tally, paper: Cell, *, judged: bool) -> Iterator[Row]:
    """Success and RMS of one line of a table."""
    success = at_least if judged else shown
    yield success(f"{name}: success", "%", tally.success_percent, paper[0])
    for axis, ours, limit in zip(_AXES, tally.rms_m, paper[1:], strict=True):
        yield (at_most if judged else shown)(f"{name}: RMS {axis}", "m", ours, limit)


def _table(case: Case, tallies: dict[str, Tally], fix: Cell, ins: Cell) -> Iterator[Row]:
    yield from _cells(f"{case.name}, {FIX}", tallies[FIX], fix, judged=True)
    yield from _cells(f"{case.name}, {FIX_HEIGHT}", tallies[FIX_HEIGHT], fix, judged=True)
    yield from _cells(f"{case.name}, SINS, {LOOSE}", tallies[LOOSE], ins, judged=True)
    for variant in (TIGHT, VEHICLE):
        name, tally = f"{case.name}, SINS, {variant}", tallies[variant]
        yield from _cells(name, tally, ins, judged=True)
        for states in (3, 9):
            test = tally.nees_test(states)
            what = {3: "position", 9: "position, velocity, attitude"}[states]
            label = f"{name}: NEES of {what} (expected {states})"
            careful = test.mean <= test.bounds[1]  # no wheel slips here, as the constraints allow
            ok = careful if variant == VEHICLE else test.consistent
            yield required(label, "1", test.mean, ok)
            yield shown(f"{label}, lower 95 % bound", "1", test.bounds[0])
            yield shown(f"{label}, upper 95 % bound", "1", test.bounds[1])


def _blocked(tallies: dict[str, Tally]) -> Iterator[Row]:
    """Horizontal RMS of the tight coupling over that of the loose one, ours and the paper's."""
    plane = {name: float(np.hypot(*tally.rms_m[:2])) for name, tally in tallies.items()}
    paper = float(np.hypot(*TABLES[2][2][1:3]))
    for variant in (TIGHT, VEHICLE):
        for what, loose in (
            ("our loose", plane[LOOSE]),
            ("the paper's loose", paper),
            (f"our {LOOSE_DIAGONAL}", plane[LOOSE_DIAGONAL]),
            (f"our {LOOSE_FIXED}", plane[LOOSE_FIXED]),
        ):
            ratio = plane[variant] / loose
            label = f"Blocked, horizontal RMS, {variant}, over {what}"
            yield required(label, "1", ratio, ratio <= TIGHT_OVER_LOOSE_MAX)


def _outages(tallies: dict[str, Tally]) -> Iterator[Row]:
    for variant in (LOOSE, TIGHT, VEHICLE):
        errors = tallies[variant].outage_m
        label = f"After 10 s without any station, SINS, {variant}"
        rms, median = np.sqrt(np.mean(errors**2, axis=0)), np.median(errors, axis=0)
        yield at_most(f"{label}: RMS, horizontal", "m", float(rms[0]), OUTAGE_LIMIT_M)
        yield at_most(f"{label}: RMS, 3-D", "m", float(rms[1]), OUTAGE_LIMIT_M)
        yield at_most(f"{label}: median, 3-D", "m", float(median[1]), OUTAGE_LIMIT_M)


def _bounds(work: Work, blocked: dict[str, Tally]) -> Iterator[Row]:
    """The posterior Cramér-Rao bound of what misses its target."""
    loose = float(np.hypot(*blocked[LOOSE].rms_m[:2]))
    for case in (OPEN, BLOCKED, OUTAGES):
        for variant, found in bounds(work, case).items():
            label = f"Bound, {case.name}, SINS, {variant}"
            for axis, ours in zip(_AXES, found.rms_m.tolist(), strict=True):
                yield shown(f"{label}: RMS {axis}", "m", ours)
            plane = float(np.hypot(*found.rms_m[:2]))
            if case == BLOCKED:
                yield shown(f"{label}: horizontal RMS over our loose", "1", plane / loose)
            if case == OUTAGES:
                end = float(np.hypot(*found.end_rms_m[:2]))
                yield shown(f"{label}: after 10 s, RMS, horizontal", "m", end)


def _smoothed(work: Work) -> Iterator[Row]:
    """Errors inside the outages, as the filter had them and given what came later."""
    for case in (OUTAGES, LONG_OUTAGES):
        for variant, found in in_outages(work, case).items():
            plane = float(np.hypot(*found.rms_m[:2]))
            yield shown(f"Inside {case.name}, SINS, {variant}: RMS, horizontal", "m", plane)


def _one_way(tallies: dict[str, Tally]) -> Iterator[Row]:
    """Times of arrival by a clock of which nothing is known at the start."""
    for variant in (TIGHT, VEHICLE):
        tally, label = tallies[variant], f"{ONE_WAY.name}, SINS, {variant}"
        for axis, ours in zip(_AXES, tally.rms_m, strict=True):
            yield shown(f"{label}: RMS {axis}", "m", ours)
        error, said = tally.clock_ns
        yield shown(f"{label}: RMS clock offset", "ns", error)
        yield shown(f"{label}: clock offset sd as stated", "ns", said)
        for states, what in ((3, "position"), (1, "clock offset")):
            test = tally.nees_test(states)
            careful = test.mean <= test.bounds[1]
            ok = careful if variant == VEHICLE else test.consistent
            yield required(f"{label}: NEES of {what} (expected {states})", "1", test.mean, ok)


def _real(work: Work) -> Iterator[Row]:
    """The real drive; every figure is None where the recording is absent."""
    there = car_drive.recording() is not None
    few = work.with_runs(min(work.runs, car_drive.SEEDS))
    for case in (OPEN, BLOCKED):
        label = f"real IMU, {case.name}"
        parts = few.over_seeds(label, car_drive.station_seeds, case) if there else []
        for variant in (LOOSE, TIGHT, VEHICLE):
            n = sum(part[variant][0] for part in parts)
            square = np.sum([part[variant][1] for part in parts], axis=0)
            rms = np.sqrt(square / n).tolist() if n else [None] * 3
            for axis, ours in zip(_AXES, rms, strict=True):
                name = f"Real IMU, {case.name}, SINS, {variant}: RMS {axis}"
                yield shown(name, "m", ours)
    for variant, what in _HELD.items():
        coasts = car_drive.outages(variant) if there else None
        for seconds, limit in ((10.0, REAL_OUTAGE_LIMIT_M), (30.0, None)):
            ours = None if coasts is None else float(np.median(coasts.at(seconds)))
            label = f"Real, {seconds:.0f} s without RTK, {what}: median horizontal error"
            yield shown(label, "m", ours) if limit is None else at_most(label, "m", ours, limit)


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
