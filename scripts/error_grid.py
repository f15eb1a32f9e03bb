"""Learned error models against the truth told, over a grid of simulated errors.

    python scripts/error_grid.py [--seeds N] [--first-seed N] [--only ROW...] [--json FILE]

RSUs around a yard, or four on a car, measure ranges of one device 5 times a second, or times while
its clock is unknown, or time differences; or four arrays on the walls of a room of 12 m by 6 m
measure two direction cosines of a person 10 times a second.
Their errors are white noise, a first-order Gauss-Markov bias each, and late paths; what they
declare is wrong.
``told`` is the tracker that was told noise, bias and correlation time (the mean one, where the
bias changes with the place), ``learned`` the one that learns from what is declared, ``declared``
the one that believes it, ``snapshot`` least squares of the last second. Figures are of the time
after 30 s: RMSE and NEES of the position (2 is expected), and errors above the protection level
while the state is TRACKING, all seeds together.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from netpos.evaluation.consistency import nees_test, whitened
from netpos.evaluation.yardsticks import Kind, Observations, Space, snapshot
from netpos.messages.values import Array

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "ros2_ws/src/netpos/test/support"))

from error_cases import (  # noqa: E402
    DEVICE_M,
    FACING_RAD,
    Case,
    Measures,
    anchors,
    measured,
    run,
)

SETTLED_S = 30.0
LARGEST_RATIO = 1.15
COMPARED = ("snapshot", "told", "declared", "learned")
Json = dict[str, Any]


def cases() -> Iterator[Case]:
    """One error at a time around the middle, for a device that moves and one that stands; times
    and time differences that are late, with clocks that walk, too; then arrays; then a car."""
    for moving in (True, False):
        middle = Case(moving=moving)
        yield middle
        for name, values in {
            "variance": (0.25, 4.0),
            "bias": (0.0, 2.0, 5.0),
            "time_s": (0.0, 3.0, 15.0),
            "blocked": (0.2, 0.4),
            "rsus": (3, 4, 8),
        }.items():
            for value in values:
                yield replace(middle, **{name: value})
    for measures in (Measures.TIMES, Measures.DIFFERENCES):
        for moving in (True, False):
            middle = Case(moving=moving, measures=measures)
            yield middle
            yield replace(middle, blocked=0.1)
            yield replace(middle, blocked=0.2)
            yield replace(middle, blocked=0.2, rsus=8)
    for walk in (1e-8, 1e-7, 5e-7):
        for moving in (True, False):
            yield Case(moving=moving, measures=Measures.TIMES, blocked=0.2, clock_walk=walk)
    yield Case(variance=4.0, bias=5.0, rsus=8)
    yield Case(variance=0.25, bias=5.0, rsus=4)
    yield Case(variance=4.0, bias=0.0, rsus=3, moving=False)
    for bias in (1.0, 2.0, 5.0):
        yield Case(bias=bias, length_m=1.0, stops=True)
    room = Case(variance=0.1, bias=2.5, rsus=4, measures=Measures.COSINES)
    yield replace(room, time_s=math.inf, moving=False)
    yield replace(room, time_s=math.inf)
    yield replace(room, moving=False)
    yield replace(room)
    yield replace(room, length_m=1.0)
    yield replace(room, length_m=1.0, stops=True)
    yield Case(bias=0.3, time_s=math.inf, rsus=4, on_a_car=True)
    yield Case(bias=0.5, rsus=4, on_a_car=True)


def figures(case: Case, seeds: range, *, told: bool, learn: bool) -> Json:
    """RMSE [m], NEES with its bounds, share of epochs without an estimate, and how many errors
    are above the level while the state is TRACKING, after 30 s."""
    settled = round(SETTLED_S * case.rate_hz)
    runs = [run(case, seed, told=told, learn=learn) for seed in seeds]
    errors = np.concatenate([(r.means - r.places)[settled:] for r in runs])
    covs = np.concatenate([r.covs[settled:] for r in runs])
    levels = np.concatenate([r.levels[settled:] for r in runs])
    known = np.isfinite(errors[:, 0])
    normalised, _ = whitened(errors[known], covs[known])
    nees = nees_test(normalised)
    if nees is None:
        raise ValueError(f"{case}: no estimate after {SETTLED_S:g} s")
    return {
        "rmse_m": math.sqrt(float(np.square(errors[known]).sum(axis=1).mean())),
        "nees_mean": nees.mean,
        "nees_bounds": list(nees.bounds),
        "without_estimate": 1.0 - float(known.mean()),
        "tracking": int(np.isfinite(levels).sum()),
        "above": int((np.linalg.norm(errors, axis=1) > levels).sum()),
    }


def observed(case: Case, seen: Array) -> Observations:
    """What was measured (n, rsus, k) as the yardstick takes it, in order of time; times of an
    unknown clock by their differences to the first."""
    n, sites = len(seen), anchors(case)
    axes = np.tile(np.eye(3), (len(sites), 1, 1))
    kinds, values, sd = [Kind.RANGE], seen, np.full_like(seen, case.noise_sd)
    if case.arrays:
        kinds = [Kind.AZIMUTH_CONE, Kind.ELEVATION]
        values, sd = np.arcsin(seen), sd / np.sqrt(1.0 - seen**2)
        c, s, o = np.cos(FACING_RAD), np.sin(FACING_RAD), np.zeros(len(sites))
        axes = np.array([[c, s, o], [-s, c, o], [o, o, o + 1.0]]).transpose(2, 0, 1)
    elif case.measures is not Measures.RANGES:
        kinds, values, sd = [Kind.TDOA], seen[:, :1] - seen[:, 1:], math.sqrt(2.0) * sd[:, 1:]
    rsus = range(len(sites) - values.shape[1], len(sites))
    stamps = np.round(1e9 * (1.0 + np.arange(n) / case.rate_hz)).astype(np.int64)
    each = np.tile(np.repeat(np.array(rsus), len(kinds)), n)
    return Observations(
        stamp_ns=np.repeat(stamps, len(each) // n),
        kind=np.tile(np.array(kinds, dtype=np.int64), len(each) // len(kinds)),
        value=values.reshape(-1),
        sd=sd.reshape(-1),
        rsu=sites[each],
        other=np.tile(sites[0], (len(each), 1)),
        axes=axes[each],
        lever_arm=np.zeros((len(each), 3)),
    )


def snapshot_rmse(case: Case, seeds: range) -> float:
    """RMSE [m] of least squares of the last second, once a second."""
    squares = []
    for seed in seeds:
        places, seen = measured(case, seed)
        rows = observed(case, seen)
        for k in range(round(SETTLED_S * case.rate_hz), len(places), round(case.rate_hz)):
            end_ns = round(1e9 * (1.0 + k / case.rate_hz))
            window = rows.window(end_ns - 1_000_000_000, end_ns)
            fix = snapshot(window, Space(height_m=DEVICE_M[case.arrays]))
            if fix is not None:
                squares.append(float(np.square(fix.state[:2] - places[k]).sum()))
    return math.sqrt(float(np.mean(squares))) if squares else math.nan


def described(case: Case) -> str:
    """A case in words."""
    what = f"{case.rsus} {case.measures}"
    what += " of a car" if case.on_a_car else ""
    how = "stops and goes" if case.stops else "moves" if case.moving else "stands"
    parts = [what, how, f"variance {case.variance:g}"]
    if case.bias:
        lasts = "ever" if math.isinf(case.time_s) else f"{case.time_s:g} s"
        lasts += "" if math.isinf(case.length_m) else f" or {case.length_m:g} m"
        parts.append(f"bias {case.bias:g} sd for {lasts}")
    if case.blocked:
        parts.append(f"{case.blocked:.0%} late")
    if case.clock_walk:
        parts.append(f"clock walks by {case.clock_walk:g}")
    return ", ".join(parts)


def row_of(case: Case, seeds: range) -> Json:
    """A row: the figures of all, and which of them are judged."""
    told = figures(case, seeds, told=True, learn=False)
    learned = figures(case, seeds, told=False, learn=True)
    ratio, (low, high) = learned["rmse_m"] / told["rmse_m"], learned["nees_bounds"]
    return {
        "name": described(case),
        "snapshot": {"rmse_m": snapshot_rmse(case, seeds)},
        "told": told,
        "declared": figures(case, seeds, told=False, learn=False),
        "learned": learned,
        "ratio": ratio,
        "targets": {
            "ratio": {"ok": ratio <= LARGEST_RATIO, "target": f"≤ {LARGEST_RATIO:g}"},
            "learned.nees_mean": {
                "ok": low <= learned["nees_mean"] <= high,
                "target": f"{low:.3g} to {high:.3g}",
            },
        },
    }


def main() -> None:
    """Run the grid, and print each row as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--only", type=int, nargs="*", help="rows to run, counted from 0")
    args = parser.parse_args()
    seeds, rows = range(args.first_seed, args.first_seed + args.seeds), []
    chosen = [case for i, case in enumerate(cases()) if not args.only or i in args.only]
    with ProcessPoolExecutor(args.workers) as pool:
        for row in pool.map(row_of, chosen, repeat(seeds)):
            rows.append(row)
            rmse = " ".join(f"{row[of]['rmse_m']:.3f}" for of in COMPARED)
            nees = " ".join(f"{row[of]['nees_mean']:.2f}" for of in COMPARED[1:])
            above = " ".join(str(row[of]["above"]) for of in COMPARED[1:])
            print(
                f"{row['name']} | RMSE [m] {rmse} ratio {row['ratio']:.2f} | NEES {nees}"
                f" | above the level {above} of {row['learned']['tracking']}"
            )
            sys.stdout.flush()
    if args.json is not None:
        document = {"runs": args.seeds, "seed": args.first_seed, "rows": rows}
        args.json.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
