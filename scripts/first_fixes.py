"""How sure and how right first fixes are, in simulation.

    python scripts/first_fixes.py [--seeds N] [--first-seed N] [--only ROW...] [--json FILE]

RSUs measure ranges of a device that walks; they declare white noise, and each has a constant bias
that it does not declare. Rows: all RSUs of a room at once, or one beacon after the other, all of
them on one side of the way. Figures are of the ten seconds after the first estimate that is
TRACKING, all seeds together: runs whose first such estimate has an error above the protection
level, the share of TRACKING estimates above it, NEES (2 expected), RMSE, mean level.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement, TrackState
from netpos.tracking.config import TrackerConfig
from netpos.tracking.tracker import Tracker

DURATION_S, JUDGED_S = 40.0, 10.0
NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Case:
    """Bias [sd of the noise declared], noise declared [m], RSUs, whether they are heard one at a
    time, ranges of each a second, speed [m/s]."""

    bias: float
    noise_m: float = 0.1
    rsus: int = 4
    in_turn: bool = False
    rate_hz: float = 5.0
    speed_mps: float = 1.0


def cases() -> Iterator[Case]:
    """Rooms with four and with eight RSUs, then beacons in turn."""
    for rsus in (4, 8):
        for bias in (0.0, 1.0, 2.0, 5.0):
            yield Case(bias, rsus=rsus)
    for bias in (0.0, 2.0, 5.0):
        yield Case(bias, noise_m=0.5, in_turn=True, rate_hz=1.0)


def anchors(case: Case) -> Array:
    """(n, 3) m: around a room of 9 m by 8 m, or beacons along one side of a field of 60 m."""
    if case.in_turn:
        x = np.linspace(-30.0, 30.0, case.rsus)
        return np.column_stack([x, 2.0 * np.cos(x), np.zeros(case.rsus)])
    corner = np.arange(case.rsus) % 4
    low = np.where(np.arange(case.rsus) < 4, 0.0, 2.2)
    x = np.where(corner < 2, -4.43, 4.43)
    y = np.where((corner == 1) | (corner == 2), 4.0, -4.0)
    return np.column_stack([x, y, low])


def way(case: Case, times: Array, rng: np.random.Generator) -> Array:
    """(n, 2) m: a lap at a constant speed, begun anywhere."""
    begun = rng.uniform(0.0, 2.0 * math.pi)
    radius = np.array([15.0, 8.0]) if case.in_turn else np.array([2.5, 2.0])
    centre = np.array([0.0, 15.0]) if case.in_turn else np.zeros(2)
    angle = begun + times * case.speed_mps / radius.mean()
    return centre + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def measurements(case: Case, seed: int) -> tuple[Array, list[RsuMeasurement]]:
    """True places (n, 2) by the number of the epoch, and the ranges."""
    rng = np.random.default_rng(seed)
    per_s = case.rate_hz * (case.rsus if case.in_turn else 1)
    times = np.arange(0.0, DURATION_S, 1.0 / per_s)
    places, rsus = way(case, times, rng), anchors(case)
    bias = rng.normal(0.0, case.bias * case.noise_m, case.rsus)
    found = []
    for k, place in enumerate(places):
        heard = [k % case.rsus] if case.in_turn else range(case.rsus)
        for i in heard:
            distance = float(np.linalg.norm(np.append(place, 0.0) - rsus[i]))
            found.append(
                RsuMeasurement(
                    stamp_ns=NS + round(times[k] * NS),
                    rsu_id=f"a{i}",
                    vue_id="vue_1",
                    sequence=k,
                    expected=len(heard),
                    fields=Field.RANGE,
                    range_m=distance + bias[i] + rng.normal(0.0, case.noise_m),
                    range_var=case.noise_m**2,
                )
            )
    return places, found


def run(case: Case, seed: int) -> Array:
    """(n, 5) of the TRACKING estimates: seconds since the first, error, level, NEES, seconds of
    the run."""
    places, measured = measurements(case, seed)
    tracker, rows = Tracker(TrackerConfig(learn_errors=True)), []
    for i, position in enumerate(anchors(case)):
        tracker.add_rsu(RsuInfo(rsu_id=f"a{i}", position=position))
    by_stamp = {m.stamp_ns: places[m.sequence] for m in measured}
    for m in measured:
        tracker.add(m)
        for output in tracker.process():
            if output.odometry is None or output.status.state is not TrackState.TRACKING:
                continue
            stamp_ns = output.status.stamp_ns
            error = output.odometry.position[:2] - by_stamp[stamp_ns]
            cov = output.odometry.pose_cov[:2, :2]
            nees = float(error @ np.linalg.solve(cov, error))
            level_m = output.status.protection_level_m
            rows.append([stamp_ns / NS, float(np.hypot(*error)), level_m, nees])
    table = np.array(rows).reshape(-1, 4)
    begun = table[:1, 0] if len(table) else np.zeros(0)
    return np.column_stack([table[:, 0] - begun.sum(), table[:, 1:], table[:, 0]])


def figures(case: Case, seeds: range) -> dict[str, float]:
    """The figures of a row."""
    runs = [run(case, seed) for seed in seeds]
    begun = [r for r in runs if len(r)]
    early = np.concatenate([r[r[:, 0] <= JUDGED_S] for r in begun]) if begun else np.empty((0, 5))
    error, level, nees = early[:, 1], early[:, 2], early[:, 3]
    return {
        "runs_without": len(runs) - len(begun),
        "begun_s": float(np.median([r[0, 4] - 1.0 for r in begun])),
        "first_above": sum(bool(r[0, 1] > r[0, 2]) for r in begun),
        "share_above": float((error > level).mean()),
        "nees": float(nees.mean()),
        "rmse_m": math.sqrt(float(np.square(error).mean())),
        "largest_m": float(error.max()),
        "level_m": float(level.mean()),
    }


def main() -> None:
    """Run the rows and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", type=int, nargs="*", help="rows to run, counted from 0")
    args = parser.parse_args()
    seeds, rows = range(args.first_seed, args.first_seed + args.seeds), []
    for i, case in enumerate(cases()):
        if args.only and i not in args.only:
            continue
        found = figures(case, seeds)
        rows.append(asdict(case) | found)
        said = ", ".join(f"{name} {value:.3g}" for name, value in found.items())
        print(
            f"{i} bias {case.bias:g} rsus {case.rsus} in_turn {case.in_turn}: {said}", flush=True
        )
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
