"""Rectangular buildings and the line of sight past them.

A building is a row (x_min, y_min, x_max, y_max). Its walls do not block: a segment along a wall or
through a corner is clear, a segment that runs through the inside is blocked."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]


@njit(cache=True)
def segment_blocked(ax: float, ay: float, bx: float, by: float, buildings: Array) -> bool:
    """Whether the segment a-b passes through the inside of any rectangle (clipping,
    Liang-Barsky)."""
    start = (ax, ay)
    step = (bx - ax, by - ay)
    for k in range(buildings.shape[0]):
        if (ax <= buildings[k, 0] and bx <= buildings[k, 0]) or (
            ax >= buildings[k, 2] and bx >= buildings[k, 2]
        ):
            continue  # wholly on one side: most buildings, and no division needed
        if (ay <= buildings[k, 1] and by <= buildings[k, 1]) or (
            ay >= buildings[k, 3] and by >= buildings[k, 3]
        ):
            continue
        enter = 0.0
        leave = 1.0
        for axis in range(2):
            low = buildings[k, axis] - start[axis]
            high = buildings[k, axis + 2] - start[axis]
            if step[axis] == 0.0:
                if low >= 0.0 or high <= 0.0:
                    leave = -1.0
                continue
            t_low = low / step[axis]
            t_high = high / step[axis]
            enter = max(enter, min(t_low, t_high))
            leave = min(leave, max(t_low, t_high))
        if enter < leave:
            return True
    return False


@njit(cache=True)
def _clear(points: Array, site: Array, buildings: Array) -> npt.NDArray[np.bool_]:
    clear = np.empty(points.shape[0], dtype=np.bool_)
    for i in range(points.shape[0]):
        clear[i] = not segment_blocked(points[i, 0], points[i, 1], site[0], site[1], buildings)
    return clear


def line_of_sight(
    points: npt.ArrayLike, site: npt.ArrayLike, buildings: npt.ArrayLike
) -> npt.NDArray[np.bool_]:
    """Which points (n, 2) see the site (2,) past the buildings (k, 4); metres. Returns (n,)."""
    clear: npt.NDArray[np.bool_] = _clear(
        np.atleast_2d(np.asarray(points, dtype=np.float64)),
        np.asarray(site, dtype=np.float64),
        np.asarray(buildings, dtype=np.float64).reshape(-1, 4),
    )
    return clear
