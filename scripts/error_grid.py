"""Learned error models against the truth told, over a grid of simulated errors.

    python scripts/error_grid.py [--seeds N] [--first-seed N] [--only ROW...] [--json FILE]

RSUs around a yard, or four on a car, measure ranges of one device 5 times a second; or four arrays
on the walls of a room of 12 m by 6 m measure two direction cosines of a person 10 times a second.
Their errors are white noise, a first-order Gauss-Markov bias each, and late paths; what they
declare is wrong.
``told`` is the tracker that was told noise, bias and correlation time (the mean one, where the
bias changes with the place), ``learned`` the one that learns from what is declared, ``declared``
the one that believes it, ``snapshot`` least squares of the last second. Figures are of the time
after 30 s: RMSE and NEES of the position (2 is expected), all seeds together.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from netpos.evaluation.yardsticks import Kind, Observations, Space, snapshot
from netpos.messages.values import Array

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "ros2_ws/src/netpos/test/support"))

from error_cases import (  # noqa: E402
    DEVICE_M,
    FACING_RAD,
    Case,
    anchors,
    measured,
    nees_of,
    run,
)

SETTLED_S = 30.0


def cases() -> Iterator[Case]:
    """One error at a time around the middle, for a device that moves and one that stands; then
    arrays; then a car."""
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
    yield Case(variance=4.0, bias=5.0, rsus=8)
    yield Case(variance=0.25, bias=5.0, rsus=4)
    yield Case(variance=4.0, bias=0.0, rsus=3, moving=False)
    for bias in (1.0, 2.0, 5.0):
        yield Case(bias=bias, length_m=1.0, stops=True)
    room = Case(variance=0.1, bias=2.5, rsus=4, arrays=True)
    yield replace(room, time_s=math.inf, moving=False)
    yield replace(room, time_s=math.inf)
    yield replace(room, moving=False)
    yield replace(room)
    yield replace(room, length_m=1.0)
    yield replace(room, length_m=1.0, stops=True)
    yield Case(bias=0.3, time_s=math.inf, rsus=4, on_a_car=True)
    yield Case(bias=0.5, rsus=4, on_a_car=True)


def figures(case: Case, seeds: range, *, told: bool, learn: bool) -> tuple[float, float, float]:
    """RMSE [m], NEES and share of epochs without an estimate, after 30 s."""
    settled = round(SETTLED_S * case.rate_hz)
    runs = [run(case, seed, told=told, learn=learn) for seed in seeds]
    errors = np.concatenate([(means - places)[settled:] for places, means, _ in runs])
    covs = np.concatenate([covs[settled:] for _, _, covs in runs])
    known = np.isfinite(errors[:, 0])
    rmse = math.sqrt(float(np.square(errors[known]).sum(axis=1).mean()))
    return rmse, float(nees_of(errors[known], covs[known]).mean()), 1.0 - float(known.mean())


def observed(case: Case, seen: Array) -> Observations:
    """What was measured (n, rsus, k) as the yardstick takes it, in order of time."""
    n, rsus, quantities = seen.shape
    kinds = [Kind.AZIMUTH_CONE, Kind.ELEVATION] if case.arrays else [Kind.RANGE]
    axes = np.tile(np.eye(3), (rsus, 1, 1))
    if case.arrays:
        c, s, o = np.cos(FACING_RAD), np.sin(FACING_RAD), np.zeros(rsus)
        axes = np.array([[c, s, o], [-s, c, o], [o, o, o + 1.0]]).transpose(2, 0, 1)
    stamps = np.round(1e9 * (1.0 + np.arange(n) / case.rate_hz)).astype(np.int64)
    sd = np.full_like(seen, case.noise_sd)
    values, sd = (np.arcsin(seen), sd / np.sqrt(1.0 - seen**2)) if case.arrays else (seen, sd)
    return Observations(
        stamp_ns=np.repeat(stamps, rsus * quantities),
        kind=np.tile(np.array(kinds, dtype=np.int64), n * rsus),
        value=values.reshape(-1),
        sd=sd.reshape(-1),
        rsu=np.tile(np.repeat(anchors(case), quantities, axis=0), (n, 1)),
        other=np.zeros((seen.size, 3)),
        axes=np.tile(np.repeat(axes, quantities, axis=0), (n, 1, 1)),
        lever_arm=np.zeros((seen.size, 3)),
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


def main() -> None:
    """Run the grid and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", type=int, nargs="*", help="rows to run, counted from 0")
    args = parser.parse_args()
    seeds, rows = range(args.first_seed, args.first_seed + args.seeds), []
    print(
        "variance bias time_s length_m blocked RSUs arrays on_car moving stops"
        " | RMSE [m] snapshot told declared learned ratio | NEES told declared learned"
    )
    for i, case in enumerate(cases()):
        if args.only and i not in args.only:
            continue
        least_squares = snapshot_rmse(case, seeds)
        told = figures(case, seeds, told=True, learn=False)
        declared = figures(case, seeds, told=False, learn=False)
        learned = figures(case, seeds, told=False, learn=True)
        found = {"told": told, "declared": declared, "learned": learned}
        rows.append(asdict(case) | {"snapshot_rmse_m": least_squares} | found)
        print(
            f"{case.variance:8g} {case.bias:4g} {case.time_s:6g} {case.length_m:8g}"
            f" {case.blocked:7g} {case.rsus:4d} {case.arrays!s:>6} {case.on_a_car!s:>6}"
            f" {case.moving!s:>6} {case.stops!s:>5}"
            f" | {least_squares:.3f} {told[0]:.3f} {declared[0]:.3f} {learned[0]:.3f}"
            f" {learned[0] / told[0]:5.2f} | {told[1]:6.2f} {declared[1]:6.2f} {learned[1]:6.2f}",
            flush=True,
        )
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
