"""A day of the tracker's core, and an hour of the live node with a recorder: whether memory and
latency stay, and whether anything is lost.

Both take long, so they are measured only where they are asked for.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from netpos.bench.common import Result, Row, within
from netpos.bench.live import executable, probe
from netpos.bench.memory import resident_bytes
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.messages.values import Array, Field, InitialPose, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker
from netpos.tracking.warm_up import warm_up

_NS = 1_000_000_000
_PLACES = {"west": (0.0, 0.0), "east": (120.0, 40.0)}
_DEVICES = 10
_RADIUS_M, _SPEED_MPS = 20.0, 2.0
_SEED = 1
_GROWTH = 1.02
_DRIFT = 1.2
_HOUR_S = 3600.0
_EVERY_S = 600
_START_S = 300.0  # of the processes, and to the end of what is under way

Sample = dict[str, float]


def soak_rows(quick: bool) -> list[Result]:
    """Ten devices, one epoch a second, for 24 simulated hours (quick: one)."""
    hours = 1 if quick else 24
    samples = list(day(hours))
    what = f"{hours} simulated hours of {_DEVICES} devices"
    return _rows(what, samples, "epoch_s", len(samples) * _EVERY_S * _DEVICES)


def live_soak_rows(quick: bool) -> list[Result]:
    """Ten devices at 10 Hz, tracker and recorder, for an hour (quick: a minute)."""
    seconds = _HOUR_S / 60.0 if quick else _HOUR_S
    figures = probe(
        "soak",
        "--recorder",
        str(executable("netpos_bag", "record")),
        "--seconds",
        f"{seconds:g}",
        "--every",
        f"{seconds / 60.0:g}",
        timeout_s=seconds + _START_S,
    )
    return live_rows(figures)


def live_rows(figures: dict[str, Any]) -> list[Result]:
    """Rows of what the probe has measured."""
    count = {name: int(figures[name]) for name in _COUNTED}
    samples: list[Sample] = figures["samples"]
    what = f"{count['seconds'] / 60:g} min of {count['devices']} live devices"
    rows = _rows(what, samples, "lag_median_s", count["sent"] // 2)
    unrecorded = count["sent"] - count["recorded_measurements"]
    unheard = count["odometry"] - count["recorded_odometry"]
    return [
        *rows,
        within(
            f"{what}: messages not handled, or not in the recording",
            abs(count["sent"] - count["handled"]) + abs(unrecorded) + abs(unheard),
            "measurements sent",
            count["sent"],
            0.0,
            unit="messages",
            note=f"Not recorded: {unrecorded} measurements, {unheard} odometry (below 0: sent by"
            " others).",
        ),
        _growth(f"{what}: memory of the recorder", samples, "recorder_memory_mb"),
    ]


_COUNTED = (
    "seconds",
    "devices",
    "sent",
    "handled",
    "odometry",
    "recorded_measurements",
    "recorded_odometry",
)


def _rows(what: str, samples: Sequence[Sample], latency: str, epochs: int) -> list[Result]:
    """Of samples with ``hours``, ``memory_mb``, a latency [s], ``missing``, ``not_finite`` and
    ``largest_error_m``."""
    missing = sum(sample["missing"] for sample in samples)
    bad = sum(sample["not_finite"] for sample in samples)
    error_m = max(sample["largest_error_m"] for sample in samples)
    part = max(len(samples) // 4, 1)
    early, late = (
        float(np.median([sample[latency] for sample in some]))
        for some in (samples[:part], samples[-part:])
    )
    series = {name: [float(sample[name]) for sample in samples] for name in samples[0]}
    return [
        replace(_growth(f"{what}: memory of the tracker", samples, "memory_mb"), series=series),
        within(
            f"{what}: latency of the last quarter",
            late,
            "that of the first",
            early,
            _DRIFT,
            note=f"Medians of the samples' medians; largest error {error_m:.2f} m.",
        ),
        within(
            f"{what}: epochs without an estimate, or with one that is not finite",
            missing + bad,
            "epochs",
            epochs,
            0.0,
            unit="epochs",
            note=f"Missing: {missing:g}; not finite: {bad:g}.",
        ),
    ]


def _growth(what: str, samples: Sequence[Sample], name: str) -> Row:
    """Memory at the end against that after a tenth."""
    values = [sample[name] for sample in samples]
    early = values[len(values) // 10]
    return within(
        what,
        values[-1],
        "after a tenth of it",
        early,
        _GROWTH,
        unit="MB",
        note=f"Grew by {1e3 * (values[-1] - early):.0f} kB.",
    )


def day(hours: float) -> Iterator[Sample]:
    """The series of the core, a sample each 10 simulated minutes: memory, median and 99 % of an
    epoch's time [s], what is missing or not finite, largest error."""
    warm_up("")  # as the node: what the first refusal would load is no growth
    tracker, rng = Tracker(), np.random.default_rng(_SEED)
    for name, (x, y) in _PLACES.items():
        tracker.add_rsu(RsuInfo(rsu_id=name, position=np.array([x, y, 0.0])))
    for device in range(_DEVICES):
        at = np.array([*_place(device, 0), 0.0])
        tracker.add(InitialPose(stamp_ns=_NS, vue_id=f"vue_{device}", position=at, cov=np.eye(3)))
    for first in range(0, round(hours * _HOUR_S), _EVERY_S):
        yield _stretch(tracker, first, rng)


def _stretch(tracker: Tracker, first: int, rng: np.random.Generator) -> Sample:
    """The next ``_EVERY_S`` simulated seconds."""
    spent, bad, largest, estimates = [], 0, 0.0, 0
    noise = rng.normal(size=(_EVERY_S, _DEVICES, 2, 2))
    for t_s in range(first, first + _EVERY_S):
        for device in range(_DEVICES):
            items = list(_epoch(device, t_s, noise[t_s - first, device]))
            begin_s = time.perf_counter()
            for item in items:
                tracker.add(item)
            outputs = tracker.process()
            spent.append(time.perf_counter() - begin_s)
            for output in outputs:
                if output.odometry is None:
                    continue
                estimates += 1
                error = float(np.hypot(*(output.odometry.position[:2] - _place(device, t_s))))
                finite = bool(np.isfinite(output.odometry.pose_cov).all())
                bad += not (math.isfinite(error) and finite)
                largest = max(largest, error)
    median, p99 = np.percentile(spent, [50, 99])
    return {
        "hours": (first + _EVERY_S) / _HOUR_S,
        "memory_mb": resident_bytes() / 1e6,
        "epoch_s": float(median),
        "epoch_p99_s": float(p99),
        "missing": _EVERY_S * _DEVICES - estimates,
        "not_finite": bad,
        "largest_error_m": largest,
    }


def _place(device: int, t_s: int) -> Array:
    """True position (2,) m."""
    angle = device + _SPEED_MPS / _RADIUS_M * t_s
    centre = np.array([40.0 + 5.0 * device, 20.0 - 4.0 * device])
    return centre + _RADIUS_M * np.array([math.cos(angle), math.sin(angle)])


def _epoch(device: int, t_s: int, noise: Array) -> Iterator[RsuMeasurement]:
    """What both RSUs measure; noise (2, 2), of azimuth and range, in sd."""
    for (name, at), (n_azimuth, n_range) in zip(_PLACES.items(), noise, strict=True):
        d = _place(device, t_s) - at
        yield RsuMeasurement(
            stamp_ns=(t_s + 1) * _NS,
            rsu_id=name,
            vue_id=f"vue_{device}",
            expected=len(_PLACES),
            fields=Field.AZIMUTH | Field.TOA,
            azimuth_rad=math.atan2(d[1], d[0]) + 0.03 * n_azimuth,
            azimuth_var=0.03**2,
            toa_s=(float(np.hypot(*d)) + n_range) / SPEED_OF_LIGHT_MPS,
            toa_var=1.0 / SPEED_OF_LIGHT_MPS**2,
        )
