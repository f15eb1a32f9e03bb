"""Routes as way-points: (n, 2) metres in map, joined by straight lines."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from netpos.world.maps import StreetGrid

Array = npt.NDArray[np.float64]

_DIRECTIONS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


def random_route(grid: StreetGrid, rng: np.random.Generator, max_crossings: int = 6) -> Array:
    """A route along the centre lines with a random turn at each crossing (fokin2020 section 2.4).

    It starts at a crossing drawn uniformly, in a direction that stays on the map. At every
    crossing it goes on in one of the three directions that are not back, each equally likely. It
    ends at crossing number ``max_crossings`` after the start, or at the map's edge where the drawn
    direction leaves the map. Collinear crossings stay in the list of way-points."""
    if max_crossings < 1:
        raise ValueError(f"max_crossings must be >= 1, got {max_crossings}")
    last = grid.blocks
    node = rng.integers(0, last + 1, size=2)
    inside = [
        d
        for d in range(4)
        if ((node + _DIRECTIONS[d] >= 0) & (node + _DIRECTIONS[d] <= last)).all()
    ]
    heading = inside[int(rng.integers(len(inside)))]
    centres = grid.centres_m
    points = [centres[node]]
    for crossing in range(1, max_crossings + 1):
        node = node + _DIRECTIONS[heading]
        points.append(centres[node])
        if crossing == max_crossings:
            break
        heading = (heading + (-1, 0, 1)[int(rng.integers(3))]) % 4
        ahead = node + _DIRECTIONS[heading]
        if (ahead < 0).any() or (ahead > last).any():
            points.append(centres[node] + _DIRECTIONS[heading] * grid.street_m / 2)
            break
    return np.array(points, dtype=np.float64)


def rectangle(corner: npt.ArrayLike, width_m: float, height_m: float, *, laps: int = 1) -> Array:
    """(4 laps + 1, 2) way-points of a closed path round a rectangle, counter-clockwise from its
    lower left corner, eastwards first."""
    if not (width_m > 0 and height_m > 0 and laps >= 1):
        raise ValueError(
            f"a rectangle needs width, height > 0 and laps >= 1, got {width_m}, {height_m}, {laps}"
        )
    ring = np.array([[0, 0], [width_m, 0], [width_m, height_m], [0, height_m]])
    return np.asarray(
        np.asarray(corner) + np.vstack([np.tile(ring, (laps, 1)), ring[:1]]), dtype=np.float64
    )
