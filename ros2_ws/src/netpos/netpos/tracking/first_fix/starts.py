"""Where a first fix starts to look: positions to which measurements point."""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.measurement import AXES, KIND, ORIGIN, VALUE, VARIANCE, Kind
from netpos.estimation.sensors.table import BY_KIND
from netpos.messages.values import Array

_RAY_M = (2.0, 6.0, 15.0, 40.0, 100.0)
_RAYS_REACH_M = 150.0  # where devices are farther from the RSUs, the rays are longer
_CIRCLE = tuple(2.0 * math.pi * i / 12 for i in range(12))


def starts_of(rows: Array, centre: Array, reach_m: float) -> list[Array]:
    """Positions to start from: along measured bearings, around measured ranges, the centre of the
    RSUs, from which a device is about ``reach_m`` away."""
    starts, rays_m = [centre], [r * max(1.0, reach_m / _RAYS_REACH_M) for r in _RAY_M]
    seen = set()
    for row in rows:
        kind = Kind(int(row[KIND]))
        key = (kind, *row[ORIGIN:AXES])
        if key in seen or kind is Kind.SPEED:
            continue
        seen.add(key)
        origin = row[ORIGIN : ORIGIN + 2]
        if kind in (Kind.AZIMUTH, Kind.COSINE_Y):
            A = row[AXES : AXES + 9].reshape(3, 3)
            angle = row[VALUE] if kind is Kind.AZIMUTH else math.asin(np.clip(row[VALUE], -1, 1))
            ray = A.T @ np.array([math.cos(angle), math.sin(angle), 0.0])
            starts += [origin + r * ray[:2] for r in rays_m]
        elif kind is Kind.TDOA:
            starts += _on_hyperbola(row, rays_m[-1])
        elif BY_KIND[kind].is_range and not BY_KIND[kind].has_clock:
            starts += [origin + row[VALUE] * np.array([math.cos(a), math.sin(a)]) for a in _CIRCLE]
        elif BY_KIND[kind].is_range:
            starts += [origin + 30.0 * np.array([math.cos(a), math.sin(a)]) for a in _CIRCLE[::3]]
    fix = rows[rows[:, KIND] == Kind.LINEAR]
    if len(fix) >= 2:
        H = fix[:, ORIGIN : ORIGIN + 2]
        starts.append(np.linalg.lstsq(H, fix[:, VALUE], rcond=None)[0])
    return starts


def _on_hyperbola(row: Array, farthest_m: float) -> list[Array]:
    """Horizontal positions, nearer than ``farthest_m`` to the RSU, from which a time difference of
    arrival would read as it does: in polar coordinates around the RSU, in the direction e,
    r = (D^2 - v^2) / (2 (e b - v)), with the reference at b, D away, and the value v."""
    between, value = row[AXES : AXES + 2], float(row[VALUE])
    excess = float(between @ between) - value * value
    found = []
    for angle in _CIRCLE:
        direction = np.array([math.cos(angle), math.sin(angle)])
        slope = 2.0 * (float(direction @ between) - value)
        if abs(slope) > 1e-9 and 0.0 < excess / slope < farthest_m:
            found.append(row[ORIGIN : ORIGIN + 2] + excess / slope * direction)
    return found


def clock_at(state: Array, rows: Array, height_m: float) -> float:
    """Clock offset [m] that fits the TOA rows best at the position of ``state``."""
    toa = rows[rows[:, KIND] == Kind.TOA]
    if not len(toa):
        return 0.0
    d = np.column_stack([state[0] - toa[:, ORIGIN], state[1] - toa[:, ORIGIN + 1]])
    distance = np.hypot(np.hypot(d[:, 0], d[:, 1]), height_m - toa[:, ORIGIN + 2])
    return float(np.average(toa[:, VALUE] - distance, weights=1.0 / toa[:, VARIANCE]))
