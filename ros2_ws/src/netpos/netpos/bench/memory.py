"""Memory of the tracker's core over an hour of input."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from netpos.bench.common import Result, Unavailable, within
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker

_STEP_NS = 100_000_000
_HOUR = 36_000  # epochs at 10 Hz
_RSUS = (
    RsuInfo(rsu_id="west", position=np.array([0.0, 0.0, 10.0])),
    RsuInfo(rsu_id="east", position=np.array([120.0, 40.0, 10.0])),
)


def resident_bytes() -> int:
    """Resident memory of this process. Raises ``Unavailable`` where /proc does not report it."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except FileNotFoundError:
        raise Unavailable("resident memory is read from /proc, which is not here.") from None
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def feed(tracker: Tracker, start: int, stop: int) -> int:
    """Two RSUs' DOA and TOA of a device on a circle, epochs ``start`` to ``stop``; returns the
    number of estimates."""
    estimates = 0
    for k in range(start, stop):
        angle = 0.02 * k
        x, y = 60.0 + 20.0 * math.cos(angle), 20.0 + 20.0 * math.sin(angle)
        for rsu in _RSUS:
            dx, dy = x - rsu.position[0], y - rsu.position[1]
            tracker.add(
                RsuMeasurement(
                    stamp_ns=(k + 1) * _STEP_NS,
                    rsu_id=rsu.rsu_id,
                    vue_id="vue_1",
                    expected=len(_RSUS),
                    fields=Field.AZIMUTH | Field.TOA,
                    azimuth_rad=math.atan2(dy, dx),
                    azimuth_var=math.radians(2.0) ** 2,
                    toa_s=math.hypot(dx, dy, 10.0) / SPEED_OF_LIGHT_MPS,
                    toa_var=(3e-9) ** 2,
                )
            )
        estimates += sum(output.odometry is not None for output in tracker.process())
    return estimates


def memory_rows(quick: bool) -> list[Result]:
    """Resident memory at the end of an hour (quick: six minutes) against that after a tenth."""
    epochs = _HOUR // 10 if quick else _HOUR
    tracker = Tracker()
    for rsu in _RSUS:
        tracker.add_rsu(rsu)
    estimates = feed(tracker, 0, epochs // 10)
    early = resident_bytes()
    estimates += feed(tracker, epochs // 10, epochs)
    late = resident_bytes()
    return [
        within(
            f"memory after {epochs / 36000:.3g} h of 10 Hz from two RSUs, tracker core",
            late / 1e6,
            "after a tenth of it",
            early / 1e6,
            1.02,
            unit="MB",
            note=f"{estimates} estimates; grew by {(late - early) / 1e3:.0f} kB.",
        )
    ]
