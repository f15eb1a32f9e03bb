"""Random networks, errors learned: what anybody's network may look like, with late paths or not.

    python scripts/random_networks.py [--networks N] [--workers N] [--json FILE]

Network k measures ranges, times of arrival while the clock of the device is unknown, time
differences to its first RSU, azimuths, or azimuths with one of the first two, in turn; its device
stands, walks or drives on a loop for a minute. Three to eight RSUs stand about it, and measure 2,
5 or 10 times a second with an sd of 0.3 m or 2 degrees, which they state, and with biases of 0, 1
or 2 sd for a minute, which they do not. The clock drifts by 10 ns/s (sd), and its drift walks by
1e-10 to 1e-6 (s/s)/sqrt(s), any power of ten as likely. In a third of the networks a tenth of the
paths is longer by 4 m in the mean; nobody says so. The tracker is told how freely the device
moves, and nothing of the clock.

All RSUs of a network measure at once. Then it is run again, each of them as often and one after
the other, but for time differences, which are those of one beacon; and where angles and times are
measured once more, heard by its first RSU alone.

Errors are those after 15 s; RMSE is the geometric mean over the networks that have an estimate
then, the others are *waiting*. *Above the level* counts errors of all epochs that say TRACKING.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement, TrackState
from netpos.tracking.config import TrackerConfig
from netpos.tracking.tracker import Tracker

C_MPS = 299_792_458.0
DURATION_S, SKIPPED_S = 60.0, 15.0
RANGE_SD_M, ANGLE_SD_RAD = 0.3, math.radians(2.0)
BIAS_TIME_S, EXCESS_M, LATE = 60.0, 4.0, 0.1
START_S = 1.0
DRIFT_SD, WALKS = 1e-8, (1e-10, 1e-6)  # [s/s], [(s/s)/sqrt(s)]
MEASURED = (
    Field.RANGE,
    Field.TOA,
    Field.TDOA,
    Field.AZIMUTH,
    Field.AZIMUTH | Field.RANGE,
    Field.AZIMUTH | Field.TOA,
)
MOVES = {"stands": (20.0, 0.0), "walks": (20.0, 1.3), "drives": (150.0, 10.0)}
"""Size of the place [m] and speed [m/s]."""
Json = dict[str, Any]


class Heard(StrEnum):
    """How the RSUs of a network hear its device; in words for its rows."""

    AT_ONCE = ""
    ONE_BY_ONE = ", one by one"
    BY_ONE_RSU = ", one RSU"

    def has(self, fields: Field) -> bool:
        """Whether networks that measure these are run so."""
        if self is Heard.BY_ONE_RSU:
            return fields == Field.AZIMUTH | Field.TOA
        return self is Heard.AT_ONCE or fields != Field.TDOA


@dataclass(frozen=True, slots=True)
class Run:
    """One network: what it measures, whether paths are late, how its RSUs hear the device; of its
    estimates when they were (n,) [s], errors (n,) [m] and NEES (n,), which say TRACKING, and which
    of those are above the level."""

    fields: Field
    late: float
    heard: Heard
    times: Array
    errors: Array
    nees: Array
    tracking: Array
    above: Array

    @property
    def settles(self) -> bool:
        """Whether there is an estimate that counts."""
        return bool((self.times >= SKIPPED_S).any())


def way(moves: str, times: Array, rng: np.random.Generator) -> Array:
    """(n, 2) m: a place, or a loop."""
    size, speed = MOVES[moves]
    if speed == 0.0:
        return np.tile(rng.uniform(-0.3, 0.3, 2) * size, (times.size, 1))
    rate = rng.uniform(0.5, 1.0, 2) * speed / (0.8 * size)
    phase = rng.uniform(0.0, 2.0 * math.pi, 2)
    return np.asarray(0.8 * size * np.sin(rate * times[:, None] + phase))


@dataclass(frozen=True, slots=True)
class Network:
    """Network ``k``: what it measures, where its RSUs are (count, 2) [m], how often and how
    they measure, the share of late paths, the sd of the biases over that of the noise,
    how the device moves, the walk of its clock, and the generators that drew all that."""

    fields: Field
    sites: Array
    rate_hz: float
    heard: Heard
    late: float
    bias_sd: float
    moves: str
    walk: float
    rng: np.random.Generator
    clock_rng: np.random.Generator

    @classmethod
    def drawn(cls, k: int, heard: Heard) -> Network:
        """With the generator at the start of its run."""
        rng, moves = np.random.default_rng(k), list(MOVES)[k // len(MEASURED) % len(MOVES)]
        count, (size, _) = int(rng.integers(3, 9)), MOVES[moves]
        angle = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
        far = size * rng.uniform(0.7, 1.3, count)
        kept = 1 if heard is Heard.BY_ONE_RSU else count
        clock_rng = np.random.default_rng([k, 1])
        return cls(
            fields=MEASURED[k % len(MEASURED)],
            sites=np.column_stack([far * np.cos(angle), far * np.sin(angle)])[:kept],
            rate_hz=float(rng.choice([2.0, 5.0, 10.0])),
            heard=heard,
            late=float(rng.choice([0.0, 0.0, LATE])),
            bias_sd=float(rng.choice([0.0, 1.0, 2.0])),
            moves=moves,
            walk=float(np.exp(clock_rng.uniform(*np.log(WALKS)))),
            rng=rng,
            clock_rng=clock_rng,
        )

    @property
    def step_s(self) -> float:
        """Time from epoch to epoch."""
        apart = len(self.sites) if self.heard is Heard.ONE_BY_ONE else 1
        return 1.0 / (self.rate_hz * apart)

    def seen(self, places: Array) -> Iterator[tuple[Array, Array]]:
        """Arrivals [m] and azimuths [rad], (count,) each, of a device at ``places`` (n, 2)."""
        rng, count = self.rng, len(self.sites)
        bias = rng.normal(0.0, self.bias_sd, (count, 2))
        clock_s, drift = rng.uniform(-1e-7, 1e-7), rng.normal(0.0, DRIFT_SD)
        keep = math.exp(-self.step_s / BIAS_TIME_S)
        step_sd = self.bias_sd * math.sqrt(1.0 - keep**2)
        for place in places:
            bias = keep * bias + rng.normal(0.0, step_sd, (count, 2))
            d = place - self.sites
            excess = rng.exponential(EXCESS_M, count) * (rng.random(count) < self.late)
            arrivals = np.hypot(*d.T) + RANGE_SD_M * bias[:, 0] + excess
            arrivals += rng.normal(0.0, RANGE_SD_M, count)
            azimuths = np.arctan2(d[:, 1], d[:, 0]) + ANGLE_SD_RAD * bias[:, 1]
            if self.fields & Field.AZIMUTH:
                azimuths += rng.normal(0.0, ANGLE_SD_RAD, count)
            if self.fields & Field.TOA:
                arrivals += C_MPS * clock_s
            yield arrivals, azimuths
            clock_s += drift * self.step_s
            drift += self.walk * math.sqrt(self.step_s) * self.clock_rng.normal()

    def messages(self, epoch: int, arrivals: Array, azimuths: Array) -> list[RsuMeasurement]:
        """What the RSUs send."""
        differs, count = self.fields is Field.TDOA, len(self.sites)
        one = self.heard is Heard.ONE_BY_ONE
        heard = [epoch % count] if one else range(differs, count)
        found = []
        for i in heard:
            values: Json = {}
            if self.fields & Field.RANGE:
                values |= {"range_m": float(arrivals[i]), "range_var": RANGE_SD_M**2}
            if self.fields & Field.TOA:
                values |= {
                    "toa_s": float(arrivals[i]) / C_MPS,
                    "toa_var": (RANGE_SD_M / C_MPS) ** 2,
                }
            if self.fields & Field.AZIMUTH:
                wrapped = (float(azimuths[i]) + math.pi) % (2.0 * math.pi) - math.pi
                values |= {"azimuth_rad": wrapped, "azimuth_var": ANGLE_SD_RAD**2}
            if differs:
                later_m, variance = (
                    float(arrivals[i] - arrivals[0]),
                    2.0 * (RANGE_SD_M / C_MPS) ** 2,
                )
                values |= {
                    "tdoa_s": later_m / C_MPS,
                    "tdoa_var": variance,
                    "reference_rsu_id": "r0",
                }
            found.append(
                RsuMeasurement(
                    stamp_ns=round(1e9 * (START_S + epoch * self.step_s)),
                    rsu_id=f"r{i}",
                    vue_id="vue_1",
                    sequence=epoch,
                    expected=len(heard),
                    fields=self.fields,
                    **values,
                )
            )
        return found


def run(k: int, heard: Heard) -> Run:
    """Track the device of network ``k``."""
    network = Network.drawn(k, heard)
    moves, times = network.moves, np.arange(0.0, DURATION_S, network.step_s)
    tracker = Tracker(
        TrackerConfig(
            learn_errors=True,
            device_height_m=0.0,
            accel_density_mps2_sqrthz=2.0 if moves == "drives" else 0.6,
            initial_speed_sd_mps=10.0 if moves == "drives" else 1.5,
        )
    )
    for i, site in enumerate(network.sites):
        tracker.add_rsu(RsuInfo(rsu_id=f"r{i}", position=np.array([*site, 0.0])))
    places, estimates = way(moves, times, network.rng), []
    for epoch, (place, seen) in enumerate(zip(places, network.seen(places), strict=True)):
        for item in network.messages(epoch, *seen):
            tracker.add(item)
        said = tracker.process()
        estimates += [(place, o.odometry, o.status) for o in said if o.odometry is not None]
    stamps = np.array([1e-9 * odometry.stamp_ns for _, odometry, _ in estimates])
    off = np.array([odometry.position[:2] - place for place, odometry, _ in estimates]).reshape(
        -1, 2
    )
    covs = np.array([odometry.pose_cov[:2, :2] for _, odometry, _ in estimates]).reshape(-1, 2, 2)
    errors = np.linalg.norm(off, axis=1)
    tracking = np.array([status.state is TrackState.TRACKING for *_, status in estimates], bool)
    levels = np.array([status.protection_level_m for *_, status in estimates])
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covs), off)
    above = tracking & (errors > levels)
    return Run(
        network.fields,
        network.late,
        heard,
        stamps - START_S,
        errors,
        nees,
        tracking,
        above,
    )


def rows_of(runs: Sequence[Run]) -> Iterator[Json]:
    """A row for each kind of measurement, direct or late, and one for all."""
    how = runs[0].heard
    for fields in MEASURED:
        for late in (0.0, LATE):
            some = [r for r in runs if r.fields == fields and r.late == late]
            if some:
                name = " and ".join(str(f.name).lower() for f in Field if f & fields)
                yield row_of(f"{name}, {late:.0%} late{how}", some)
    if how is not Heard.BY_ONE_RSU:
        yield row_of(f"all{how}", runs)


def row_of(name: str, runs: Sequence[Run]) -> Json:
    """The figures of some networks together; those without an estimate that counts are waiting."""
    settled = [r.errors[r.times >= SKIPPED_S] for r in runs if r.settles]
    rmse = [math.sqrt(float(np.square(errors).mean())) for errors in settled]
    nees = [float(r.nees[r.tracking].mean()) for r in runs if r.settles and r.tracking.any()]
    return {
        "name": name,
        "networks": len(runs),
        "waiting": len(runs) - len(settled),
        "rmse_m": math.exp(float(np.log(rmse).mean())) if rmse else None,
        "max_m": max(float(errors.max()) for errors in settled) if rmse else None,
        "nees_mean": float(np.mean(nees)) if nees else None,
        "tracking": sum(int(r.tracking.sum()) for r in runs),
        "estimates": sum(len(r.errors) for r in runs),
        "above": sum(int(r.above.sum()) for r in runs),
    }


def main() -> None:
    """Run the networks, and print a row for each kind of measurement."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--networks", type=int, default=180)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[Json] = []
    with ProcessPoolExecutor(args.workers) as pool:
        for heard in Heard:
            some = [k for k in range(args.networks) if heard.has(MEASURED[k % len(MEASURED)])]
            rows += rows_of(list(pool.map(run, some, [heard] * len(some))))
    print("| measured | networks | waiting | RMSE [m] | largest [m] | NEES | TRACKING | above |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for row in rows:
        figures = (
            f"{row[key]:.3g}" if row[key] else "" for key in ("rmse_m", "max_m", "nees_mean")
        )
        counts = f"{row['networks']} | {row['waiting']}"
        said = f"{row['tracking']} of {row['estimates']} | {row['above']}"
        print(f"| {row['name']} | {counts} | {' | '.join(figures)} | {said} |")
    if args.json is not None:
        document = {"networks": args.networks, "rows": rows}
        args.json.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
