"""Measurements as neutral arrays, and their expected values at a point.

a         = p + R(heading) l                     antenna with lever arm l
azimuth   = atan2(u_y, u_x), or asin(u_y / |u|) of a cone array; u = a - rsu in the RSU's axes
elevation = asin(u_z / |u|)
range     = |a - rsu|
TDOA      = |a - other| - |a - rsu|              [m]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from netpos.messages.values import Array

Stamps = NDArray[np.int64]
NS = 1_000_000_000


class Kind(IntEnum):
    """What one row measures; AZIMUTH_CONE is the angle whose sine is the direction cosine."""

    AZIMUTH = 0
    AZIMUTH_CONE = 1
    ELEVATION = 2
    RANGE = 3
    TDOA = 4


ANGLES = (Kind.AZIMUTH, Kind.AZIMUTH_CONE, Kind.ELEVATION)


@dataclass(frozen=True, slots=True, kw_only=True)
class Observations:
    """n measurements in order of their stamps.

    stamp_ns : (n,); kind : (n,) of ``Kind``; value : (n,) rad or m; sd : (n,) the same unit, > 0
    rsu : (n, 3) m; other : (n, 3) m, second RSU of a TDOA, else not used
    axes : (n, 3, 3) map to RSU axes, of angles; lever_arm : (n, 3) m in the device's axes

    Raises
    ------
    ValueError  lengths differ, stamps decrease, or a value is not finite or an sd not positive
    """

    stamp_ns: Stamps
    kind: NDArray[np.int64]
    value: Array
    sd: Array
    rsu: Array
    other: Array
    axes: Array
    lever_arm: Array

    def __post_init__(self) -> None:
        n = len(self.stamp_ns)
        for name in (f.name for f in fields(self)):
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} has {len(getattr(self, name))} rows, stamp_ns has {n}")
        if (np.diff(self.stamp_ns) < 0).any():
            raise ValueError("stamps decrease; sort the measurements first")
        if not (np.isfinite(self.value).all() and (self.sd > 0).all()):
            raise ValueError("a value is not finite or an sd is not positive")

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, index: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Observations:
        """The rows at ``index``."""
        return Observations(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def window(self, from_ns: int, to_ns: int) -> Observations:
        """Rows with from_ns < stamp <= to_ns."""
        low, high = np.searchsorted(self.stamp_ns, [from_ns, to_ns], side="right")
        return self.take(slice(int(low), int(high)))

    @property
    def turns(self) -> bool:
        """Whether several antennas of the device were measured, so that its heading shows."""
        return bool(len(self)) and bool(np.ptp(self.lever_arm[:, :2], axis=0).max() > 0.0)


def ranges(
    stamp_ns: Sequence[int] | Stamps,
    rsu: Array,
    value: Array,
    sd: float,
    other: Array | None = None,
) -> Observations:
    """Ranges to ``rsu`` (n, 3), or TDOA of ``other`` (n, 3) minus ``rsu``, of one sd [m]."""
    n = len(value)
    return Observations(
        stamp_ns=np.asarray(stamp_ns, dtype=np.int64),
        kind=np.full(n, Kind.RANGE if other is None else Kind.TDOA, dtype=np.int64),
        value=np.asarray(value, dtype=np.float64),
        sd=np.full(n, sd),
        rsu=np.asarray(rsu, dtype=np.float64).reshape(n, 3),
        other=np.zeros((n, 3)) if other is None else np.asarray(other, dtype=np.float64),
        axes=np.broadcast_to(np.eye(3), (n, 3, 3)),
        lever_arm=np.zeros((n, 3)),
    )


def residuals(seen: Observations, point: Array, heading: float = 0.0) -> tuple[Array, Array]:
    """Measured minus expected (n,), angles in [-pi, pi), and the derivative of the expected value
    by x, y, z and heading (n, 4).

    point : (3,) m in map; heading : rad counter-clockwise from x
    """
    cos, sin = np.cos(heading), np.sin(heading)
    lx, ly, lz = seen.lever_arm.T
    turned = np.column_stack([cos * lx - sin * ly, sin * lx + cos * ly, lz])
    offset = point + turned - seen.rsu
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    ray = offset / distance[:, None]
    expected, slope = distance.copy(), ray.copy()
    angles = np.flatnonzero(seen.kind < Kind.RANGE)
    if angles.size:
        expected[angles], slope[angles] = _angles(seen, angles, offset[angles], distance[angles])
    pairs = np.flatnonzero(seen.kind == Kind.TDOA)
    if pairs.size:
        beyond = point + turned[pairs] - seen.other[pairs]
        farther = np.maximum(np.linalg.norm(beyond, axis=1), 1e-9)
        expected[pairs] = farther - distance[pairs]
        slope[pairs] = beyond / farther[:, None] - ray[pairs]
    error = seen.value - expected
    error[angles] = (error[angles] + np.pi) % (2.0 * np.pi) - np.pi
    by_heading = slope[:, 1] * turned[:, 0] - slope[:, 0] * turned[:, 1]
    return error, np.column_stack([slope, by_heading])


def _angles(
    seen: Observations, rows: NDArray[np.int64], offset: Array, distance: Array
) -> tuple[Array, Array]:
    """Angles (k,) of ``rows`` and their derivative by the point (k, 3)."""
    axes, kind = seen.axes[rows], seen.kind[rows]
    u = np.einsum("nij,nj->ni", axes, offset)
    level2 = np.maximum(u[:, 0] ** 2 + u[:, 1] ** 2, 1e-18)
    angle = np.arctan2(u[:, 1], u[:, 0])
    slope = np.column_stack([-u[:, 1] / level2, u[:, 0] / level2, np.zeros(len(u))])
    for which, axis in ((Kind.AZIMUTH_CONE, 1), (Kind.ELEVATION, 2)):
        k = np.flatnonzero(kind == which)
        sine = u[k, axis] / distance[k]
        cosine = np.sqrt(np.maximum(1.0 - sine**2, 1e-12))
        angle[k] = np.arcsin(np.clip(sine, -1.0, 1.0))
        by_u = -sine[:, None] * u[k] / distance[k, None]
        by_u[:, axis] += 1.0
        slope[k] = by_u / (distance[k] * cosine)[:, None]
    return angle, np.einsum("ni,nij->nj", slope, axes)
