"""Ground truth of a recording: poses of a file or topic, and their velocities."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from netpos.bags.errors import BagError
from netpos.bags.importers.common import truth_of_poses
from netpos.bags.importers.own.columns import ANGLE, CLOCK_NS, LENGTH, pairs, time_ns
from netpos.bags.importers.own.records import Record, Skipped, number
from netpos.common.parameters import nearest
from netpos.messages.values import Array, Odometry

Stamps = NDArray[np.int64]

QUATERNION = ("qx", "qy", "qz", "qw")
TUM = {name: str(column) for column, name in enumerate(("time", "x", "y", "z", *QUATERNION), 1)}
ODOMETRY = {
    "time": "header.stamp",
    **{axis: f"pose.pose.position.{axis}" for axis in "xyz"},
    **{f"q{axis}": f"pose.pose.orientation.{axis}" for axis in "xyzw"},
}
INTERVAL_NS = 50_000_000
"""Poses closer than this are left out: their stamps jitter, and velocities are differences."""
_STANDING_MPS = 0.2
_WORDS = ("time", "x", "y", "z", "yaw", *QUATERNION)


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthColumns:
    """Where a pose stands: time, x, y and, where known, z and yaw or a quaternion."""

    sources: Mapping[str, str]
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.sources:
            if name not in _WORDS:
                raise ValueError(
                    f"--truth-map knows no {name!r}{nearest(name, _WORDS)}; it knows "
                    f"{', '.join(_WORDS)}"
                )
        missing = [name for name in ("time", "x", "y") if name not in self.sources]
        if missing:
            raise ValueError(f"--truth-map must name {', '.join(missing)}")
        known: dict[str, Iterable[str]] = {
            "time": [*CLOCK_NS, "iso"],
            "position": LENGTH,
            "yaw": ANGLE,
        }
        for name, unit in self.units.items():
            if unit not in known.get(name, ()):
                raise ValueError(
                    f"--truth-units {name}={unit}: it takes time, position and yaw, in "
                    f"{', '.join([*CLOCK_NS, 'iso', *LENGTH, *ANGLE])}"
                )

    @classmethod
    def parse(cls, mapping: str, units: str = "") -> TruthColumns:
        """From the text of the options; ValueError for what it does not know."""
        return cls(sources=pairs(mapping, "--truth-map"), units=pairs(units, "--truth-units"))

    def pose(self, record: Record) -> tuple[int, float, float, float, float] | None:
        """Stamp [ns], x, y, z [m] and yaw [rad] (NaN: not known); None where values are empty."""
        if any(number(record, self.sources[name], name) is None for name in ("x", "y")):
            return None
        factor = LENGTH[self.units.get("position", "m")]
        place = [
            factor * (number(record, self.sources[name], name) or 0.0)
            if name in self.sources
            else 0.0
            for name in "xyz"
        ]
        stamp = time_ns(record, self.sources["time"], self.units.get("time", "s"))
        return stamp, place[0], place[1], place[2], self._yaw(record)

    def _yaw(self, record: Record) -> float:
        if "yaw" in self.sources:
            value = number(record, self.sources["yaw"], "yaw")
            return math.nan if value is None else value * ANGLE[self.units.get("yaw", "rad")]
        if not set(QUATERNION) <= set(self.sources):
            return math.nan
        values = [number(record, self.sources[name], name) for name in QUATERNION]
        if None in values:
            return math.nan
        x, y, z, w = (float(value or 0.0) for value in values)
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """stamps_ns (n,) increasing, values (n, 4): x y z m, yaw rad (NaN where not known)."""

    stamps_ns: Stamps
    values: Array

    def shifted(self, offset_ns: int) -> Poses:
        """The same poses, later by ``offset_ns``."""
        return replace(self, stamps_ns=self.stamps_ns + offset_ns)

    def turned(self, angle_rad: float, shift: Array) -> Poses:
        """Turned about z, then moved by ``shift`` (3,) m."""
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        places = self.values[:, :3] @ turn.T + shift
        return replace(self, values=np.column_stack([places, self.values[:, 3] + angle_rad]))

    def odometry(self, vue_id: str) -> list[Odometry]:
        """Ground truth with velocities; where no yaw is given it is the course while the device
        moves, and stays while it stands."""
        values = self.values.copy()
        if not np.isfinite(values[:, 3]).all():
            values[:, 3] = _course(self.stamps_ns, values[:, :2])
        return truth_of_poses(self.stamps_ns.tolist(), values, vue_id)


def poses_of(
    found: Iterable[tuple[int, float, float, float, float] | None], skipped: Skipped
) -> Poses:
    """Poses in the order of time, none closer than 0.05 s.

    Raises ``BagError`` where fewer than two are left.
    """
    kept: list[tuple[int, float, float, float, float]] = []
    for pose in found:
        if pose is None:
            skipped["empty poses of the truth"] += 1
        else:
            kept.append(pose)
    kept.sort(key=lambda pose: pose[0])
    thinned: list[tuple[int, float, float, float, float]] = []
    for pose in kept:
        if not thinned or pose[0] - thinned[-1][0] >= INTERVAL_NS:
            thinned.append(pose)
    if len(thinned) < 2:
        raise BagError("the truth holds fewer than two poses 0.05 s apart; velocities need two")
    return Poses(
        np.array([pose[0] for pose in thinned], dtype=np.int64),
        np.array([pose[1:] for pose in thinned]),
    )


def _course(stamps_ns: Stamps, places: Array) -> Array:
    """(n,) rad."""
    velocity = np.gradient(places, (stamps_ns - stamps_ns[0]) / 1e9, axis=0)
    moving = np.flatnonzero(np.hypot(velocity[:, 0], velocity[:, 1]) > _STANDING_MPS)
    if not moving.size:
        return np.zeros(len(places))
    course = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    latest = np.searchsorted(moving, np.arange(len(places)), side="right") - 1
    return np.asarray(course[np.maximum(latest, 0)])
