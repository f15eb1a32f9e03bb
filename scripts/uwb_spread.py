"""How much the UWB recordings of a car's anchors depend on settings and chance: ``python
scripts/uwb_spread.py``. RMSE and NEES (LOS, NLOS), one setting at a time against those that are
used; then of the same walks with ranges drawn from the error model the importer declares."""

from __future__ import annotations

import math
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from netpos.bags import BagReader, codec
from netpos.bags.importers.common import RangeErrors
from netpos.bags.importers.uwb_anchors import ERRORS, TRACKER, import_uwb_anchors
from netpos.evaluation.consistency import nees
from netpos.messages import topics
from netpos.messages.values import Array, RsuInfo, RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.tracker import Tracker

RUNS = ("LOS", "NLOS")
SEEDS = range(5000, 5020)
FACTORS = (0.8, 1.25)
SKIP = 20
Recording = tuple[list[RsuInfo], list[RsuMeasurement], Array]


def _load(bag: Path) -> Recording:
    """RSUs, measurements in order, truth (n, 4): stamp [ns], x, y, z [m]."""
    with BagReader(bag) as source:
        infos = [codec().rsu_info_from_msg(e.message) for e in source.messages([topics.RSU_INFO])]
        heard = [
            codec().measurement_from_msg(e.message)
            for e in source.messages([topics.RSU_MEASUREMENTS])
        ]
        name = topics.of_vue("vue_1", topics.GROUND_TRUTH)
        poses = [codec().odometry_from_msg(e.message) for e in source.messages([name])]
    return infos, heard, np.array([[p.stamp_ns, *p.position] for p in poses])


def _at(truth: Array, stamps_ns: Array) -> Array:
    columns = [np.interp(stamps_ns, truth[:, 0], truth[:, k]) for k in (1, 2, 3)]
    return np.column_stack(columns)


def _score(recording: Recording, **parameters: Any) -> tuple[float, float]:
    """RMSE [m] and mean NEES of a tracker's horizontal position."""
    infos, heard, truth = recording
    tracker = Tracker(TrackerConfig.from_mapping({**TRACKER, **parameters}))
    for info in infos:
        tracker.add_rsu(info)
    outputs = []
    for measurement in heard:
        tracker.add(measurement)
        outputs += tracker.process()
    outputs += tracker.flush()
    odometry = [o.odometry for o in outputs if o.odometry is not None][SKIP:]
    odometry = [o for o in odometry if truth[0, 0] <= o.stamp_ns <= truth[-1, 0]]
    place = _at(truth, np.array([o.stamp_ns for o in odometry], dtype=float))
    error = np.array([o.position[:2] for o in odometry]) - place[:, :2]
    values, _ = nees(error, np.array([o.pose_cov[:2, :2] for o in odometry]))
    return math.sqrt(float((error**2).sum(axis=1).mean())), float(values.mean())


def _settings() -> list[tuple[str, RangeErrors, dict[str, Any]]]:
    used, accel = ERRORS, float(TRACKER["accel_density_mps2_sqrthz"])
    settings: list[tuple[str, RangeErrors, dict[str, Any]]] = [("as used", used, {})]
    settings += [(f"filter {name}", used, {"filter": name}) for name in ("ekf", "ukf")]
    settings += [
        (f"initial speed {sd:g} m/s", used, {"initial_speed_sd_mps": sd}) for sd in (2.0, 5.0)
    ]
    for factor in FACTORS:
        changed = {"accel_density_mps2_sqrthz": factor * accel}
        settings.append((f"acceleration x {factor:g}", used, changed))
        for name in ("range_sd_m", "range_bias_sd_m", "bias_correlation_time_s"):
            errors = replace(used, **{name: factor * getattr(used, name)})
            settings.append((f"{name} x {factor:g}", errors, {}))
        name = "noise_correlation_time_s"
        errors = replace(used, **{name: factor * getattr(used, name)})
        settings.append((f"{name} x {factor:g}", errors, {}))
    return settings


def _markov(rng: np.random.Generator, time_s: Array, sd: float, tau_s: float) -> Array:
    """(n,) first-order Gauss-Markov process of stationary ``sd`` at increasing times."""
    keep = np.exp(-np.diff(time_s, prepend=time_s[0]) / tau_s)
    draws, value = rng.standard_normal(time_s.size), np.empty(time_s.size)
    value[0] = sd * draws[0]
    for k in range(1, time_s.size):
        fresh = sd * math.sqrt(1.0 - keep[k] ** 2)
        value[k] = keep[k] * value[k - 1] + fresh * draws[k]
    return value


def _drawn(recording: Recording, seed: int) -> Recording:
    """The recording with ranges along its true way and errors as declared."""
    infos, heard, truth = recording
    heard = [m for m in heard if truth[0, 0] <= m.stamp_ns <= truth[-1, 0]]
    rng, used = np.random.default_rng(seed), ERRORS
    stamps = np.array([m.stamp_ns for m in heard], dtype=float)
    time_s = (stamps - stamps[0]) * 1e-9
    order = np.argsort(time_s, kind="stable")
    place = _at(truth, stamps)
    place[:, 2] = TRACKER["device_height_m"]
    ranges = np.empty(len(heard))
    common = (used.common_range_bias_sd_m, used.common_bias_correlation_time_s)
    ranges[order] = _markov(rng, time_s[order], *common)
    for info in infos:
        its = order[[heard[k].rsu_id == info.rsu_id for k in order]]
        ranges[its] += np.linalg.norm(place[its] - info.position, axis=1)
        slow = (used.range_bias_sd_m, used.bias_correlation_time_s)
        fast = (used.range_sd_m, used.noise_correlation_time_s / 2.0)
        ranges[its] += _markov(rng, time_s[its], *slow) + _markov(rng, time_s[its], *fast)
    drawn = [replace(m, range_m=float(r)) for m, r in zip(heard, ranges, strict=True)]
    return infos, drawn, truth


def _simulated(recordings: dict[str, Recording]) -> None:
    for run, recording in recordings.items():
        rmse: dict[str, Array] = {}
        drawn = [_drawn(recording, seed) for seed in SEEDS]
        for name in ("iekf", "ekf", "ukf"):
            scores = np.array([_score(each, filter=name) for each in drawn])
            rmse[name] = scores[:, 0]
            ratio = rmse[name] / rmse["iekf"]
            sys.stdout.write(
                f"{run}, errors drawn, {name}: RMSE {scores[:, 0].mean():.3f} m (sd of one"
                f" {scores[:, 0].std():.3f}), NEES {scores[:, 1].mean():.2f}, over iekf"
                f" {ratio.mean():.3f} (sd of one {ratio.std():.3f})\n"
            )


def main() -> int:
    """Print one line per setting; 1 where the recordings are absent."""
    root = Path(__file__).resolve().parents[1]
    data = Path(os.environ.get("NETPOS_DATA", root / "../shared/data")) / "uwb_car_anchors"
    if not data.is_dir():
        sys.stderr.write(f"no recordings {data}: set NETPOS_DATA\n")
        return 1
    used: dict[str, Recording] = {}
    with tempfile.TemporaryDirectory() as folder:
        for k, (name, errors, parameters) in enumerate(_settings()):
            cells = []
            for run in RUNS:
                bag = Path(folder) / f"{run}_{k}"
                import_uwb_anchors(data / run, bag, errors=errors)
                recording = _load(bag)
                used.setdefault(run, recording)
                cells.append("{:.3f} m, NEES {:.2f}".format(*_score(recording, **parameters)))
            sys.stdout.write(f"{name:32s} {'   '.join(cells)}\n")
    _simulated(used)
    return 0


if __name__ == "__main__":
    sys.exit(main())
