"""Learned error models against the truth told, over a grid of simulated errors.

    python scripts/error_grid.py [--seeds N] [--first-seed N] [--only ROW...] [--json FILE]

RSUs around a yard measure ranges of one device 5 times a second. Their errors are white noise, a
first-order Gauss-Markov bias each, and late paths; what they declare is wrong. ``told`` is the
tracker that was told noise, bias and correlation time (the mean one, where the bias changes with
the place), ``learned`` the one that learns from what is declared, ``declared`` the one that
believes it. Figures are of the time after 30 s: RMSE and NEES of the position (2 is expected), all
seeds together.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.tracker import Tracker

RATE_HZ, DURATION_S, SETTLED_S = 5.0, 90.0, 30.0
NOISE_SD_M = 0.1
GO_S, STOP_AND_GO_S = 5.0, 20.0


@dataclass(frozen=True, slots=True)
class Case:
    """True errors: variance over the one declared, bias [sd of the noise declared], correlation
    time [s] and length [m], share of blocked paths; RSUs; whether the device moves. With a length,
    it stops and goes."""

    variance: float = 1.0
    bias: float = 1.0
    time_s: float = 60.0
    length_m: float = math.inf
    blocked: float = 0.0
    rsus: int = 5
    moving: bool = True


def cases() -> Iterator[Case]:
    """One error at a time around the middle, for a device that moves and one that stands."""
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
        yield Case(bias=bias, length_m=1.0)


def walk(case: Case, times: Array) -> Array:
    """(n, 2) m: a loop of 8 m by 5 m at 1 m/s or less, all the time or by turns, or a place."""
    if not case.moving:
        return np.tile([2.0, -1.5], (times.size, 1))
    if math.isfinite(case.length_m):
        rounds, begun_s = np.divmod(times, STOP_AND_GO_S)
        times = GO_S * rounds + np.minimum(begun_s, GO_S)
    angle = times / 8.0
    return np.column_stack([8.0 * np.cos(angle), 5.0 * np.sin(angle)])


def anchors(case: Case) -> Array:
    """(n, 3) m, evenly around the yard."""
    angle = 2.0 * np.pi * (np.arange(case.rsus) + 0.3) / case.rsus
    return np.column_stack([15.0 * np.cos(angle), 12.0 * np.sin(angle), np.full(case.rsus, 3.0)])


def decays(case: Case, places: Array) -> Array:
    """(n - 1,): what is left of a bias from one of ``places`` (n, 2) to the next."""
    way_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    per_s = math.inf if case.time_s == 0.0 else 1.0 / case.time_s
    left: Array = np.exp(-per_s / RATE_HZ - way_m / case.length_m)
    return left


def ranges(case: Case, seed: int) -> tuple[Array, Array]:
    """True places (n, 2) and ranges (n, rsus) of one run."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    places, rsus = walk(case, times), anchors(case)
    distance = np.linalg.norm(np.column_stack([places, 0 * times])[:, None] - rsus, axis=2)
    noise_sd, bias_sd = math.sqrt(case.variance) * NOISE_SD_M, case.bias * NOISE_SD_M
    bias = np.empty_like(distance)
    bias[0] = rng.normal(0.0, bias_sd, case.rsus)
    for k, decay in enumerate(decays(case, places).tolist(), start=1):
        step_sd = bias_sd * math.sqrt(1.0 - decay**2)
        bias[k] = decay * bias[k - 1] + rng.normal(0.0, step_sd, case.rsus)
    late = rng.exponential(3.0, distance.shape) * (rng.random(distance.shape) < case.blocked)
    return places, distance + bias + rng.normal(0.0, noise_sd, distance.shape) + late


def tracker_of(case: Case, places: Array, *, told: bool, learn: bool) -> tuple[Tracker, float]:
    """A tracker that knows the RSUs, and the variance [m^2] that they state. ``told``: noise, bias
    and its correlation time on the way along ``places`` (n, 2) are the true ones."""
    variance = (case.variance if told else 1.0) * NOISE_SD_M**2
    time_s = 0.0
    if told and case.time_s > 0.0:
        time_s = -1.0 / (RATE_HZ * float(np.log(decays(case, places)).mean()))
    elif told:
        variance += (case.bias * NOISE_SD_M) ** 2
    tracker = Tracker(
        TrackerConfig(
            accel_density_mps2_sqrthz=0.3,
            initial_speed_sd_mps=1.0,
            learn_errors=learn,
            nlos_probability=0.2 if case.blocked > 0.0 else 0.0,
            nlos_mean_excess_m=3.0,
        )
    )
    for i, position in enumerate(anchors(case)):
        tracker.add_rsu(
            RsuInfo(
                rsu_id=f"a{i}",
                position=position,
                range_bias_sd_m=case.bias * NOISE_SD_M if time_s > 0.0 else 0.0,
                bias_correlation_time_s=time_s if case.bias > 0.0 else 0.0,
            )
        )
    return tracker, variance


def run(case: Case, seed: int, *, told: bool, learn: bool) -> tuple[Array, Array]:
    """Errors (n, 2) m and NEES (n,) after 30 s; an epoch without an estimate is not a number."""
    places, measured = ranges(case, seed)
    tracker, variance = tracker_of(case, places, told=told, learn=learn)
    errors, nees = [], []
    for k, (place, row) in enumerate(zip(places, measured, strict=True)):
        stamp_ns = round(1e9 * (1.0 + k / RATE_HZ))
        for i, value in enumerate(row.tolist()):
            tracker.add(
                RsuMeasurement(
                    stamp_ns=stamp_ns,
                    rsu_id=f"a{i}",
                    vue_id="vue_1",
                    sequence=k,
                    expected=case.rsus,
                    fields=Field.RANGE,
                    range_m=value,
                    range_var=variance,
                )
            )
        for output in tracker.process():
            if k < SETTLED_S * RATE_HZ:
                continue
            if output.odometry is None:
                errors.append([math.nan, math.nan])
                nees.append(math.nan)
                continue
            error = output.odometry.position[:2] - place
            cov = output.odometry.pose_cov[:2, :2]
            errors.append(error)
            nees.append(float(error @ np.linalg.solve(cov, error)))
    return np.array(errors), np.array(nees)


def figures(case: Case, seeds: range, *, told: bool, learn: bool) -> tuple[float, float, float]:
    """RMSE [m], NEES and share of epochs without an estimate."""
    runs = [run(case, seed, told=told, learn=learn) for seed in seeds]
    errors, nees = (np.concatenate([r[i] for r in runs]) for i in (0, 1))
    known = np.isfinite(nees)
    rmse = math.sqrt(float(np.square(errors[known]).sum(axis=1).mean()))
    return rmse, float(nees[known].mean()), 1.0 - float(known.mean())


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
        "variance bias time_s length_m blocked RSUs moving | RMSE [m] told declared learned ratio"
        " | NEES told declared learned"
    )
    for i, case in enumerate(cases()):
        if args.only and i not in args.only:
            continue
        told = figures(case, seeds, told=True, learn=False)
        declared = figures(case, seeds, told=False, learn=False)
        learned = figures(case, seeds, told=False, learn=True)
        rows.append(asdict(case) | {"told": told, "declared": declared, "learned": learned})
        print(
            f"{case.variance:8g} {case.bias:4g} {case.time_s:6g} {case.length_m:8g}"
            f" {case.blocked:7g} {case.rsus:4d} {case.moving!s:>6}"
            f" | {told[0]:.3f} {declared[0]:.3f} {learned[0]:.3f}"
            f" {learned[0] / told[0]:5.2f} | {told[1]:6.2f} {declared[1]:6.2f} {learned[1]:6.2f}",
            flush=True,
        )
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
