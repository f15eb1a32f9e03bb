"""Measure dead reckoning on the public recordings:
python scripts/pdr_results.py [DATA_FOLDER] [--json FILE]."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from netpos.evaluation.pedestrian import (
    PdrRun,
    heading_and_tilt_error,
    run_core,
    score_contacts,
    score_walk,
)
from netpos.inertial import loaders
from netpos.inertial.length import LengthScale
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_config import PdrConfig

Row = tuple[str, str, str, str, bool]

MARGIN_NS = 200_000_000
STEPS = ("user1_bag", "user1_frontpocket", "user2_hand", "user2_armband")
ATTITUDES = {
    "slow": "imu_mag_attitude/04_undisturbed_slow_rotation_with_breaks_A.mat",
    "fast": "imu_mag_attitude/15_undisturbed_fast_translation_A.mat",
}


def carried(**values: object) -> PedestrianDeadReckoning:
    return PedestrianDeadReckoning(PdrConfig.from_mapping(values))


def step_rows(data: Path) -> Iterator[Row]:
    for name in STEPS:
        record = loaders.load_steps_phone(data / f"steps_phone/{name}.csv")
        count, true = len(run_core(record.imu, carried()).events), record.true_step_ns.size
        error = 100 * (count / true - 1)
        yield f"{name}: steps", f"{count} of {true}", f"{error:+.2f} %", "1 %", abs(error) <= 1


def contact_rows(data: Path) -> Iterator[Row]:
    for name in ("HA_001", "HA_002"):
        record = loaders.load_waist_imu(data / f"waist_imu/{name}/data.mat")
        run = run_core(record.imu, carried(placement="waist"))
        s = score_contacts([e.end_ns for e in run.events], record.bouts)
        share, false = 100 * s.found / s.listed, 100 * s.false / (s.found + s.false)
        text = f"{s.found} of {s.listed}"
        yield f"{name}: contacts found", text, f"{share:.1f} %", ">= 95 %", share >= 95
        text = f"{s.false}, and {s.unlisted} untimed"
        yield f"{name}: false detections", text, f"{false:.1f} %", "<= 5 %", false <= 5
        yield waist_distance(name, record, run)


def waist_distance(name: str, record: loaders.WaistRecord, run: PdrRun) -> Row:
    """Distance of all bouts against the reference; aim: within 2 of the sd that is stated."""
    ours = true = 0.0
    for bout in record.bouts:
        first, last = bout.initial_contact_ns[[0, -1]]
        near = (e for e in run.events if first - MARGIN_NS <= e.end_ns <= last + MARGIN_NS)
        ours += sum(e.length_m for e in near)
        true += bout.length_m
    ratio, sd = 100 * (ours / true - 1), 100 * run.core.config.length_scale_sd
    text = f"{ours:.1f} of {true:.1f} m"
    aim = f"2 sd of {sd:.0f} %"
    return f"{name}: distance", text, f"{ratio:+.0f} %", aim, abs(ratio) <= 2 * sd


def walk_rows(data: Path) -> Iterator[Row]:
    record = loaders.load_pdr_phone(data / "pdr_phone/site1_F1.txt")
    for with_mag in (True, False):
        for model in ("weinberg", "frequency"):
            core = carried(length_model=model)
            run = run_core(record.imu, core, with_magnetometer=with_mag)
            s = score_walk(run.events, record)
            name = f"phone walk, {model}{'' if with_mag else ', no magnetometer'}"
            ratio = 100 * (s.distance_m / s.true_distance_m - 1)
            text = f"{s.distance_m:.1f} of {s.true_distance_m:.1f} m"
            yield f"{name}: distance", text, f"{ratio:+.2f} %", "3 %", abs(ratio) <= 3
            for what, value in (("RMS", s.rmse_m), ("largest", s.max_m)):
                share = 100 * value / s.true_distance_m
                text = f"{value:.2f} m"
                yield f"{name}: way-points, {what}", text, f"{share:.2f} %", "3 %", share <= 3
    yield from calibrated_rows(record)


def calibrated_rows(record: loaders.WaypointRecord) -> Iterator[Row]:
    """The scale calibrated on one half of the walk, scored on the other."""
    legs = np.hypot(*np.diff(record.waypoint_m, axis=0).T)
    middle = int(np.searchsorted(np.cumsum(legs), legs.sum() / 2))
    for model in ("weinberg", "frequency"):
        events = run_core(record.imu, carried(length_model=model)).events
        ends = np.array([e.end_ns for e in events])
        way = np.interp(record.waypoint_ns, ends, np.cumsum([e.length_m for e in events]))
        ours = np.diff(way)
        halves = (slice(0, middle + 1), slice(middle + 1, None))
        for learn, test in (halves, halves[::-1]):
            scale = LengthScale(1.0, PdrConfig().length_scale_sd)
            for modelled, true in zip(ours[learn], legs[learn], strict=True):
                scale.observe(float(modelled), float(true), 1.0)
            distance, true = scale.mean * ours[test].sum(), legs[test].sum()
            ratio = 100 * (distance / true - 1)
            half = "second" if test is halves[1] else "first"
            name = f"phone walk, {model}, {half} half after the other: distance"
            yield (
                name,
                f"{distance:.1f} of {true:.1f} m",
                f"{ratio:+.2f} %",
                "3 %",
                abs(ratio) <= 3,
            )


def attitude_rows(data: Path) -> Iterator[Row]:
    for pace, file in ATTITUDES.items():
        record = loaders.load_imu_mag_attitude(data / file)
        use = record.moving & np.isfinite(record.quaternion).all(axis=1)
        for with_mag in (True, False):
            run = run_core(record.imu, carried(), with_magnetometer=with_mag)
            errors = heading_and_tilt_error(run.attitude[use], record.quaternion[use])
            for what, error in zip(("heading", "tilt"), errors, strict=True):
                rms = float(np.degrees(np.sqrt(np.mean(error**2))))
                name = f"attitude, {pace}{'' if with_mag else ', no magnetometer'}: {what}, RMS"
                aim = "3 deg" if with_mag else ""
                yield name, f"{rms:.2f} deg", "", aim, rms <= 3 or not with_mag


def main() -> None:
    """Print the table; exit 1 where a recording is absent."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    parser = argparse.ArgumentParser(description=__doc__)
    folder = os.environ.get("NETPOS_DATA", default)
    parser.add_argument("data", nargs="?", type=Path, default=folder, help="folder of recordings")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as JSON")
    arguments = parser.parse_args()
    data, recorded = Path(arguments.data), []
    print("| what | measured | error | aim | met |\n|---|---|---|---|---|")
    try:
        for rows in (step_rows, contact_rows, walk_rows, attitude_rows):
            for name, text, error, aim, met in rows(data):
                print(f"| {name} | {text} | {error} | {aim} | {'yes' if met else '**no**'} |")
                row: dict[str, Any] = {"name": name, "ours": text, "error": error}
                if aim:
                    row["targets"] = {"ours": {"ok": bool(met), "target": aim}}
                recorded.append(row)
    except FileNotFoundError as error:
        sys.exit(f"netpos: {error}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"rows": recorded}, indent=2) + "\n")


if __name__ == "__main__":
    main()
