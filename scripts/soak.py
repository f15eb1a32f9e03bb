#!/usr/bin/env python3
"""A day of running without ROS: ten devices, two RSUs, one epoch a second, 24 simulated hours.

Every 10 simulated minutes: resident memory, time of an epoch, estimates that are missing or not
finite, largest error. Writes the series as CSV and a picture; exit 1 where memory grew by more
than 2 % after the first hour, an estimate is missing, or one is not finite.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from netpos.messages.values import Field, InitialPose, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker

NS = 1_000_000_000
PLACES = {"west": (0.0, 0.0), "east": (120.0, 40.0)}
DEVICES = 10
RADIUS_M, SPEED_MPS = 20.0, 2.0
GROWTH_MAX = 0.02
EVERY_S = 600
C = 299_792_458.0


@dataclass(frozen=True, slots=True)
class Sample:
    """State after some simulated time; epoch time [s] is the median and 99 % since the last."""

    hours: float
    memory_mb: float
    epoch_median_us: float
    epoch_p99_us: float
    estimates: int
    missing: int
    not_finite: int
    largest_error_m: float


def place(device: int, t_s: int) -> np.ndarray:
    """True position (2,) m."""
    angle = device + SPEED_MPS / RADIUS_M * t_s
    centre = np.array([40.0 + 5.0 * device, 20.0 - 4.0 * device])
    return centre + RADIUS_M * np.array([math.cos(angle), math.sin(angle)])


def epoch(device: int, t_s: int, noise: np.ndarray) -> Iterator[RsuMeasurement]:
    """What both RSUs measure; noise (2, 2)."""
    for (name, at), (n_azimuth, n_range) in zip(PLACES.items(), noise, strict=True):
        d = place(device, t_s) - at
        yield RsuMeasurement(
            stamp_ns=(t_s + 1) * NS,
            rsu_id=name,
            vue_id=f"vue_{device}",
            expected=2,
            fields=Field.AZIMUTH | Field.TOA,
            azimuth_rad=math.atan2(d[1], d[0]) + 0.03 * n_azimuth,
            azimuth_var=0.03**2,
            toa_s=(float(np.hypot(*d)) + n_range) / C,
            toa_var=1.0 / C**2,
        )


def memory_mb() -> float:
    """Resident memory [1e6 bytes]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def soak(hours: float, seed: int) -> Iterator[Sample]:
    """The series, sample by sample."""
    tracker, rng = Tracker(), np.random.default_rng(seed)
    for name, (x, y) in PLACES.items():
        tracker.add_rsu(RsuInfo(rsu_id=name, position=np.array([x, y, 0.0])))
    for device in range(DEVICES):
        at = np.array([*place(device, 0), 0.0])
        pose = InitialPose(stamp_ns=NS, vue_id=f"vue_{device}", position=at, cov=np.eye(3))
        tracker.add(pose)
    for first in range(0, round(hours * 3600), EVERY_S):
        yield stretch(tracker, first, rng)


def stretch(tracker: Tracker, first: int, rng: np.random.Generator) -> Sample:
    """The next ``EVERY_S`` simulated seconds."""
    spent, bad, largest, estimates = [], 0, 0.0, 0
    noise = rng.normal(size=(EVERY_S, DEVICES, 2, 2))
    for t_s in range(first, first + EVERY_S):
        for device in range(DEVICES):
            items = list(epoch(device, t_s, noise[t_s - first, device]))
            begin_s = time.perf_counter()
            for item in items:
                tracker.add(item)
            outputs = tracker.process()
            spent.append(time.perf_counter() - begin_s)
            for output in outputs:
                if output.odometry is None:
                    continue
                estimates += 1
                error = float(np.hypot(*(output.odometry.position[:2] - place(device, t_s))))
                cov = output.odometry.pose_cov
                bad += not (math.isfinite(error) and bool(np.isfinite(cov).all()))
                largest = max(largest, error)
    median, p99 = np.percentile(spent, [50, 99]) * 1e6
    missing = EVERY_S * DEVICES - estimates
    hours = (first + EVERY_S) / 3600
    return Sample(hours, memory_mb(), median, p99, estimates, missing, bad, largest)


def draw(samples: list[Sample], path: Path) -> None:
    """Memory and time of an epoch over the simulated hours."""
    picture = Figure(figsize=(7.0, 4.5), layout="constrained")
    above, below = picture.subplots(2, 1, sharex=True)
    hours = [s.hours for s in samples]
    above.plot(hours, [s.memory_mb for s in samples])
    above.set_ylabel("resident memory [MB]")
    above.set_ylim(bottom=0.0)
    below.plot(hours, [s.epoch_median_us for s in samples], label="median")
    below.plot(hours, [s.epoch_p99_us for s in samples], label="99 %")
    below.set_ylabel("one epoch [µs]")
    below.set_xlabel("simulated time [h]")
    below.set_ylim(bottom=0.0)
    below.legend()
    picture.savefig(path)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="simulated")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/soak"), help=".csv and .svg")
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    samples = []
    with options.out.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, Sample.__slots__)
        writer.writeheader()
        for sample in soak(options.hours, options.seed):
            samples.append(sample)
            writer.writerow(asdict(sample))
            file.flush()
    draw(samples, options.out.with_suffix(".svg"))
    settled = next((s for s in samples if s.hours >= 1.0), samples[0])
    growth = samples[-1].memory_mb / settled.memory_mb - 1.0
    missing = sum(s.missing for s in samples)
    bad = sum(s.not_finite for s in samples)
    print(
        f"{samples[-1].hours:g} h: memory {settled.memory_mb:.1f} to "
        f"{samples[-1].memory_mb:.1f} MB ({100 * growth:+.2f} %), epoch "
        f"{settled.epoch_median_us:.0f} to {samples[-1].epoch_median_us:.0f} us, {missing} "
        f"estimates missing, {bad} not finite, "
        f"largest error {max(s.largest_error_m for s in samples):.2f} m"
    )
    return int(growth > GROWTH_MAX or missing > 0 or bad > 0)


if __name__ == "__main__":
    sys.exit(main())
