"""Score netpos and two baselines on every real recording.

    python scripts/real_data.py --json FILE [--out FOLDER] [--data DIR] [--only NAME ...]

Imports each recording an importer knows, replays it with the bag's parameters and with default
ones, runs a snapshot least squares and a plain Kalman filter on the same bag
(netpos.evaluation.yardsticks), and writes one row per recording. --out keeps the bags in a new
folder.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import real_data_readers as readers
from netpos.bags.importers import (
    ble_aoa,
    import_ble_aoa,
    import_uwb_anchors,
    import_uwb_trolley,
    uwb_anchors,
    uwb_trolley,
)
from netpos.evaluation import evaluate_bag
from netpos.evaluation.recordings import Recording, baseline_figures, recording_row
from netpos.evaluation.yardsticks import Kind, PlainConfig, Space, observations_of_bag
from netpos.scenario.recorded_drive import import_car_drive

Json = dict[str, Any]
Source = tuple[str, Path, Callable[[Path, Path], object], dict[str, Any]]

DATA = Path(os.environ.get("NETPOS_DATA", Path(__file__).parents[2] / "shared" / "data")).resolve()
BLE_RUNS = ("uc1_run1", "uc1_run2", "uc2_run1", "uc3_run1")
UWB_RUNS = ("LOS", "NLOS", "LOS_gap")
AZIMUTHS = (Kind.AZIMUTH, Kind.AZIMUTH_CONE)


def sources(data: Path) -> Iterator[Source]:
    """Of recordings of one device: name, a file or folder that must exist, the import, and what
    the baselines use."""
    folder = data / "ble_aoa"
    level = Space(height_m=ble_aoa.TAG_HEIGHT_M)
    for run in BLE_RUNS:
        needed = folder / f"beacons_{run}.csv"
        yield f"ble_{run}", needed, partial(_ble, folder, run), {"space": level}
    level = Space(height_m=uwb_anchors.TAG_HEIGHT_M)
    for run in UWB_RUNS:
        folder = data / "uwb_car_anchors" / run
        used = {"space": level, "range_sd_m": readers.UWB_SD_M, "reference": authors_m(folder)}
        yield f"uwb_{run}", folder, import_uwb_anchors, used
    level = Space(height_m=float(uwb_trolley.TRACKER["device_height_m"]))
    used = {"space": level, "range_sd_m": readers.UWB_SD_M}
    yield "uwb_trolley", data / "uwb_trolley", import_uwb_trolley, used
    yield from own_recordings(data)
    used = {"space": Space(dimensions=3)}
    yield "car_imu_rtk (stations simulated)", data / "car_imu_rtk", import_car_drive, used


def own_recordings(data: Path) -> Iterator[Source]:
    """Recordings that no importer knows, read by naming their columns (docs/own_recording.md),
    with the standard deviation of a data sheet."""
    folder = data / "uwb_ranging"
    used = {"space": Space(height_m=1.18)}
    yield "uwb_ranging four_anchors", folder / "four_anchors", readers.import_four_anchors, used
    used = {"space": Space(height_m=readers.IASL_HEIGHT_M)}
    yield "uwb_ranging iasl (truth aligned)", folder / "iasl_scenario1", readers.import_iasl, used
    used = {"space": Space()}
    yield "range_beacons Plaza1", data / "range_beacons", readers.import_plaza, used
    used = {"space": Space(dimensions=3, height_m=1.0), "range_sd_m": readers.UWB_SD_M}
    yield "uwb_tdoa", data / "uwb_tdoa", readers.import_uwb_tdoa, used


def several_devices(data: Path) -> Iterator[Source]:
    """Recordings of many devices, each of them short; every estimate of theirs counts."""
    folder = data / "5g_raytraced"
    for name, what in (("5x5_square", "square"), ("trajectory", "street")):
        used: dict[str, Any] = {"space": Space(), "skip": 0}
        file = folder / f"{name}_100MHz.csv.gz"
        yield f"5g_raytraced {what}", file, readers.import_raytraced, used
    level = Space(
        height_m=float(readers.AIRCRAFT["device_height_m"]),
        sd_max_m=float(readers.AIRCRAFT["initial_position_sd_max_m"]),
    )
    yield "adsb_mlat", data / "adsb_mlat", readers.import_adsb, {"space": level, "skip": 0}


def _ble(folder: Path, run: str, _: Path, bag: Path) -> None:
    import_ble_aoa(folder, bag, run=run)


def authors_m(folder: Path) -> float | None:
    """The authors' best horizontal RMSE [m]; None where they give none."""
    file = folder / "authors_results.txt"
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    return min((float(m) for m in re.findall(r"RMSE_2d: ([\d.]+)", text)), default=None)


def measured(source: Source, folder: Path) -> Json:
    """The row of a recording that an importer reads."""
    name, path, load, used = source
    bag = folder / f"{name}_imported"
    load(path, bag)
    recording = Recording(name=name, bag=bag, **used)
    row = recording_row(recording, folder)
    if name.startswith("ble_"):
        row["azimuth_only"] = _azimuth_only(recording, folder / name)
    return row


def _azimuth_only(recording: Recording, replayed: Path) -> Json:
    """RMSE of the baselines on all their epochs without the elevations, as figures were published
    for these walks before."""
    seen = observations_of_bag(recording.bag, kinds=AZIMUTHS)
    truth = evaluate_bag(replayed).vues["vue_1"].run.truth
    found = baseline_figures(seen, recording.space, truth)
    return {f"{name}_rmse_m": figures["rmse_m"] for name, figures in found.items()}


def measure(data: Path, folder: Path, only: list[str]) -> Json:
    """All rows; ``absent`` names the recordings that ``data`` does not hold."""
    rows, absent = [], []
    started = time.monotonic()
    for source in (*sources(data), *several_devices(data)):
        if only and source[0] not in only:
            continue
        if source[1].exists():
            rows.append(_timed(source[0], partial(measured, source, folder)))
        else:
            absent.append(source[0])
    for name in absent:
        sys.stderr.write(f"netpos: {name} is absent from {data}\n")
    wall_s = time.monotonic() - started
    return {"wall_s": wall_s, "plain_ekf": asdict(PlainConfig()), "rows": rows, "absent": absent}


def _timed(name: str, work: Callable[[], Json]) -> Json:
    started = time.monotonic()
    row = work()
    row["wall_s"] = time.monotonic() - started
    sys.stderr.write(f"{name}: {row['wall_s']:.0f} s\n")
    return row


def table(rows: list[Json]) -> str:
    """RMSE [m] of all columns as Markdown."""

    def cell(figures: Json | float | None) -> str:
        value = figures["rmse_m"] if isinstance(figures, dict) else figures
        return "–" if value is None else f"{value:.3f}"

    columns = ("reference", "snapshot", "plain_ekf", "declared", "learned", "ours", "defaults")
    lines = [
        "| recording | authors | snapshot | plain EKF | declared | learned | ours | defaults |"
    ]
    lines.append("|---|---|---|---|---|---|---|---|")
    lines += [f"| {row['name']} | {' | '.join(cell(row[c]) for c in columns)} |" for row in rows]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Write the file and print the table of RMSE; 1 where no recording is there."""
    parser = argparse.ArgumentParser(description="Score netpos and baselines on real recordings.")
    parser.add_argument("--json", type=Path, required=True, help="file of the figures")
    parser.add_argument("--out", type=Path, help="new folder for the bags; else none is kept")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings")
    parser.add_argument("--only", nargs="+", default=[], help="names of recordings; else all")
    options = parser.parse_args(arguments)
    if options.out is not None and options.out.exists():
        parser.error(f"{options.out} exists; choose a new folder")
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        found = measure(options.data, folder, options.only)
    if not found["rows"]:
        sys.stderr.write(f"netpos: no recording in {options.data}; set --data or NETPOS_DATA\n")
        return 1
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(table(found["rows"]) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
