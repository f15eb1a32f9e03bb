"""A straight walk before one anchor with a long baseline, measured and tracked."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from netpos.estimation.rows import linear_rows, rsu_axes, rsu_rows
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement, Velocity
from netpos.tracking import Tracker, TrackerConfig, TrackOutput
from scipy.spatial.transform import Rotation

T0, DT_NS = 1_000_000_000, 100_000_000
WAVELENGTH, TURNS = 0.05, 4.0
SCALE = 2 * math.pi * TURNS
RANGE_SD, PHASE_SD, VELOCITY_SD = 0.03, math.radians(6.0), 0.05
NORTH = Rotation.from_euler("z", 90, degrees=True).as_quat()
INFO = RsuInfo(
    rsu_id="anchor",
    position=np.zeros(3),
    quaternion=NORTH,
    baseline_m=TURNS * WAVELENGTH,
    wavelength_m=WAVELENGTH,
)
CONFIG: dict[str, Any] = {
    "filter": "srukf",
    "initial_speed_sd_mps": 1.5,
    "hold_s": 0.0,
    "accel_density_mps2_sqrthz": 1.0,
}


def true_values(xy: Array) -> tuple[Array, Array]:
    """Ranges and unwrapped phases of positions (n, 2), in the paper's words: x along the array,
    y ahead of it."""
    to_master = np.hypot(xy[:, 0] - INFO.baseline_m / 2, xy[:, 1])
    return to_master, SCALE * np.sin(np.arctan2(xy[:, 0], xy[:, 1]))


def wrap(phase: Array) -> Array:
    wrapped: Array = (phase + math.pi) % (2 * math.pi) - math.pi
    return wrapped


@dataclass
class Walk:
    """What is measured of a straight walk at 1 m/s."""

    start: Array
    heading_rad: float
    seconds: float
    seed: int = 0
    hidden: tuple[float, float] = (math.inf, math.inf)
    spoilt: tuple[float, float] = (math.inf, math.inf)
    position: Array = field(init=False)
    ranges: Array = field(init=False)
    phases: Array = field(init=False)
    velocities: Array = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        n = round(self.seconds * 10)
        self.velocity = np.array([math.cos(self.heading_rad), math.sin(self.heading_rad)])
        self.position = self.start + np.arange(n)[:, None] * 0.1 * self.velocity
        ranges, phases = true_values(self.position)
        self.ranges = ranges + RANGE_SD * rng.standard_normal(n)
        self.phases = wrap(phases + PHASE_SD * rng.standard_normal(n))
        self.velocities = self.velocity + VELOCITY_SD * rng.standard_normal((n, 2))

    def items(self, k: int) -> list[Any]:
        t, stamp = k / 10, T0 + k * DT_NS
        items: list[Any] = [
            Velocity(
                stamp_ns=stamp,
                vue_id="v",
                velocity=self.velocities[k],
                cov=np.eye(2) * VELOCITY_SD**2,
            )
        ]
        if not self.hidden[0] <= t < self.hidden[1]:
            off = 2.5 if self.spoilt[0] <= t < self.spoilt[1] else 0.0
            items.append(self.measured(k, off))
        return items

    def measured(self, k: int, off: float = 0.0) -> RsuMeasurement:
        return RsuMeasurement(
            stamp_ns=T0 + k * DT_NS,
            rsu_id="anchor",
            vue_id="v",
            expected=1,
            fields=Field.RANGE | Field.PHASE,
            range_m=self.ranges[k],
            range_var=RANGE_SD**2,
            phase_difference_rad=float(wrap(np.array(self.phases[k] + off))),
            phase_difference_var=PHASE_SD**2,
        )


def tracked(walk: Walk, first: list[Any] | None = None, **config: Any) -> list[TrackOutput]:
    """Outputs of a tracker, one per epoch."""
    tracker = Tracker(TrackerConfig(**(CONFIG | config)))
    tracker.add_rsu(INFO)
    for item in first or []:
        assert tracker.add(item) is None
    outputs: list[TrackOutput] = []
    for k in range(len(walk.position)):
        for item in walk.items(k):
            assert tracker.add(item) is None
        outputs += tracker.process()
    return [*outputs, *tracker.flush()]


def errors(walk: Walk, outputs: list[TrackOutput]) -> Array:
    by_stamp = {o.status.stamp_ns: o.odometry for o in outputs}
    found = [by_stamp[T0 + k * DT_NS] for k in range(len(walk.position))]
    assert all(o is not None for o in found)
    places = np.array([o.position[:2] for o in found if o is not None])
    distance: Array = np.hypot(*(places - walk.position).T)
    return distance


def rows_at(walk: Walk, k: int, velocity_sd: float) -> Array:
    rows = rsu_rows(walk.measured(k), INFO, rsu_axes(INFO), 0)
    known = linear_rows(walk.velocity, np.eye(2) * velocity_sd**2, np.eye(2, 6, k=2), 1)
    return np.vstack([rows, known])
