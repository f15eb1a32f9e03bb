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
from netpos.bags.importers.own.records import Record, Skipped, number, problem
from netpos.common.parameters import nearest
from netpos.messages.values import UNKNOWN_HEIGHT_VAR, Array, Odometry
from netpos.world.geodesy import Datum

Stamps = NDArray[np.int64]
Pose = tuple[int, float, float, float, float]

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
_PLACE, _ON_EARTH = ("x", "y", "z"), ("latitude", "longitude", "height")
_WORDS = ("time", *_PLACE, *_ON_EARTH, "yaw", *QUATERNION)
POSE = {name: place.removeprefix("pose.") for name, place in ODOMETRY.items()}
NAV_SAT_FIX = {
    "time": "header.stamp",
    "latitude": "latitude",
    "longitude": "longitude",
    "height": "altitude",
}
# What a message of a kind has, and where the pose of that kind stands.
_KINDS = (("pose.pose", ODOMETRY), ("pose.position", POSE), ("latitude", NAV_SAT_FIX))


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthColumns:
    """Where a pose stands: time, x, y and, where known, z and yaw or a quaternion; or latitude,
    longitude (deg, WGS84) and height above the ellipsoid (m) in place of x, y, z.
    """

    sources: Mapping[str, str]
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.sources:
            if name not in _WORDS:
                raise ValueError(
                    f"--truth-map knows no {name!r}{nearest(name, _WORDS)}; it knows "
                    f"{', '.join(_WORDS)}"
                )
        if set(_PLACE) & set(self.sources) and self.on_earth:
            raise ValueError("--truth-map takes x, y, z or latitude, longitude, height, not both")
        missing = [name for name in ("time", *self._place[:2]) if name not in self.sources]
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

    @property
    def on_earth(self) -> bool:
        """Whether places are latitudes and longitudes."""
        return bool(set(_ON_EARTH) & set(self.sources))

    @property
    def has_height(self) -> bool:
        """Whether there is a third coordinate."""
        return self._place[2] in self.sources

    @property
    def _place(self) -> tuple[str, str, str]:
        return _ON_EARTH if self.on_earth else _PLACE

    @classmethod
    def of_kind(cls, message: Record) -> TruthColumns:
        """Those of an Odometry, a pose, or a NavSatFix. ``BagError`` for another kind."""
        for has, sources in _KINDS:
            try:
                message.value(has)
            except BagError:
                continue
            return cls(sources=sources)
        raise problem(message, "no Odometry, PoseStamped or NavSatFix; name --truth-map")

    @classmethod
    def parse(cls, mapping: str, units: str = "") -> TruthColumns:
        """From the text of the options; ValueError for what it does not know."""
        return cls(sources=pairs(mapping, "--truth-map"), units=pairs(units, "--truth-units"))

    def pose(self, record: Record) -> Pose | None:
        """Stamp [ns], x, y, z [m] (or latitude, longitude [deg] and height [m]) and yaw
        [rad] (NaN: not known); None where values are empty."""
        read = {
            name: number(record, self.sources[name], name)
            for name in self._place
            if name in self.sources
        }
        if any(read[name] is None for name in self._place[:2]):
            return None
        factor = 1.0 if self.on_earth else LENGTH[self.units.get("position", "m")]
        place = [factor * (read.get(name) or 0.0) for name in self._place]
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
    """stamps_ns (n,) increasing, values (n, 4): x y z m, yaw rad (NaN where not known); where
    there is no height, z is 0 and its variance says so."""

    stamps_ns: Stamps
    values: Array
    has_height: bool = True

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
        truth = truth_of_poses(self.stamps_ns.tolist(), values, vue_id)
        if not self.has_height:
            for pose in truth:
                pose.pose_cov[2, 2] = UNKNOWN_HEIGHT_VAR
        return truth


def poses_of(found: Iterable[Pose | None], skipped: Skipped) -> Poses:
    """Poses in the order of time, none closer than 0.05 s.

    Raises ``BagError`` where fewer than two are left.
    """
    kept: list[Pose] = []
    for pose in found:
        if pose is None:
            skipped["empty poses of the truth"] += 1
        else:
            kept.append(pose)
    kept.sort(key=lambda pose: pose[0])
    thinned: list[Pose] = []
    for pose in kept:
        if not thinned or pose[0] - thinned[-1][0] >= INTERVAL_NS:
            thinned.append(pose)
    if len(thinned) < 2:
        raise BagError("the truth holds fewer than two poses 0.05 s apart; velocities need two")
    return Poses(
        np.array([pose[0] for pose in thinned], dtype=np.int64),
        np.array([pose[1:] for pose in thinned]),
    )


def local(poses: Poses, origin: tuple[float, float, float] | None) -> Poses:
    """Poses of latitude, longitude [deg, WGS84] and height [m] as metres east, north and up of
    ``origin``; None: of the first pose."""
    datum = Datum(*(origin or poses.values[0, :3].tolist()))
    places = datum.to_map(poses.values[:, :3])
    return replace(poses, values=np.column_stack([places, poses.values[:, 3]]))


def _course(stamps_ns: Stamps, places: Array) -> Array:
    """(n,) rad."""
    velocity = np.gradient(places, (stamps_ns - stamps_ns[0]) / 1e9, axis=0)
    moving = np.flatnonzero(np.hypot(velocity[:, 0], velocity[:, 1]) > _STANDING_MPS)
    if not moving.size:
        return np.zeros(len(places))
    course = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    latest = np.searchsorted(moving, np.arange(len(places)), side="right") - 1
    return np.asarray(course[np.maximum(latest, 0)])
