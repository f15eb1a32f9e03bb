"""Figures of a weighted cloud of positions: moments, radius, modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from netpos.messages.values import Array
from scipy.ndimage import distance_transform_edt, gaussian_filter

Ints = npt.NDArray[np.int64]

CELLS = 64
SMOOTHING_CELLS = 1.5
DIP = 0.5  # two peaks are one mode unless the density between them falls below this share
LEAST_MASS = 0.01  # a lighter mode does not count
_TAIL = 5e-4


@dataclass(frozen=True, slots=True)
class Cloud:
    """Positions xy (N, 2) with weights (N,) that sum to one."""

    xy: Array
    weights: Array

    @property
    def mean(self) -> Array:
        """Mean (2,)."""
        mean: Array = self.weights @ self.xy
        return mean

    @property
    def cov(self) -> Array:
        """Covariance (2, 2)."""
        d = self.xy - self.mean
        cov: Array = (self.weights[:, None] * d).T @ d
        return cov

    def radius(self, share: float = 0.95) -> float:
        """Radius [m] of the smallest circle about the mean that holds ``share`` of the weight."""
        distance = np.hypot(*(self.xy - self.mean).T)
        order = np.argsort(distance)
        at = int(np.searchsorted(np.cumsum(self.weights[order]), share))
        return float(distance[order[min(at, len(order) - 1)]])

    def share_within(self, distance: float) -> float:
        """Weight of the circle of radius ``distance`` [m] about the mean."""
        return float(self.weights[np.hypot(*(self.xy - self.mean).T) < distance].sum())


class Modes:
    """Modes of a cloud: peaks of its density on a grid along its principal axes.

    Peaks merge from the highest level down, where the
    density between them reaches ``DIP`` of the lower one (zero-dimensional persistence).
    """

    def __init__(self, cloud: Cloud) -> None:
        self._mean, (_, self._axes) = cloud.mean, np.linalg.eigh(cloud.cov)
        along = (cloud.xy - self._mean) @ self._axes
        edges = [_weighted_range(along[:, k], cloud.weights) for k in range(2)]
        self._low = np.array([e[0] for e in edges])
        self._size = np.maximum(np.array([e[1] - e[0] for e in edges]), 1e-9)
        flat = np.ravel_multi_index(tuple(self._cells(cloud.xy).T), (CELLS, CELLS))
        mass = np.bincount(flat, cloud.weights, CELLS * CELLS).reshape(CELLS, CELLS)
        self._region = _regions(gaussian_filter(mass, SMOOTHING_CELLS, mode="constant"))
        shares = np.bincount(self._region[self._cells_of(cloud.xy)], cloud.weights)
        kept = np.flatnonzero(shares >= LEAST_MASS)
        self._kept = kept[np.argsort(-shares[kept])]
        self.weights: Array = shares[self._kept]
        """Share of each mode, the heaviest first; what is lighter than LEAST_MASS is left out."""

    def shares_of(self, xy: Array) -> Array:
        """Share of the positions xy (n, 2) in the region of each mode."""
        counts = np.bincount(self._region[self._cells_of(xy)], minlength=self._kept.max() + 1)
        shares: Array = counts[self._kept] / len(xy)
        return shares

    def _cells(self, xy: Array) -> Ints:
        share = ((xy - self._mean) @ self._axes - self._low) / self._size
        cells: Ints = np.clip(np.floor(share * CELLS), 0, CELLS - 1).astype(np.int64)
        return cells

    def _cells_of(self, xy: Array) -> tuple[Ints, Ints]:
        cells = self._cells(xy)
        return cells[:, 0], cells[:, 1]


def _weighted_range(values: Array, weights: Array) -> tuple[float, float]:
    """Where all but the tails are, and a margin."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    low = values[order[np.searchsorted(total, _TAIL)]]
    high = values[order[min(int(np.searchsorted(total, 1.0 - _TAIL)), len(order) - 1)]]
    margin = 0.05 * (high - low)
    return float(low - margin), float(high + margin)


def _regions(density: Array) -> Ints:
    """Number of the mode of every cell (CELLS, CELLS)."""
    flat = density.reshape(-1)
    parent = np.full(flat.size, -1, dtype=np.int64)

    def root(cell: int) -> int:
        while parent[cell] != cell:
            parent[cell] = parent[parent[cell]]
            cell = int(parent[cell])
        return cell

    for cell in np.argsort(-flat, kind="stable").tolist():
        if flat[cell] <= 1e-12 * flat.max():
            break
        row, column = divmod(cell, CELLS)
        parent[cell], near = cell, set()
        for r in range(max(row - 1, 0), min(row + 2, CELLS)):
            for c in range(max(column - 1, 0), min(column + 2, CELLS)):
                other = r * CELLS + c
                if other != cell and parent[other] >= 0:
                    near.add(root(other))
        if not near:
            continue
        peaks = sorted(near, key=lambda peak: (-flat[peak], peak))
        parent[cell] = peaks[0]
        for lower in peaks[1:]:
            if flat[cell] > DIP * flat[lower]:
                parent[lower] = peaks[0]
    label = np.array([root(cell) if parent[cell] >= 0 else -1 for cell in range(flat.size)])
    _, numbers = np.unique(label, return_inverse=True)
    numbers = numbers.reshape(CELLS, CELLS)
    empty = label.reshape(CELLS, CELLS) < 0
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    filled: Ints = numbers[tuple(nearest)]
    return filled
