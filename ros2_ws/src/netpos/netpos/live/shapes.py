"""What a viewer draws, as plain values, and which of it has gone since the last frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from netpos.messages.values import Array

Colour = tuple[float, float, float, float]
"""Red, green, blue, opacity; each from 0 to 1."""
ORIGIN = (0.0, 0.0, 0.0)
_CORNERS = 48  # of a circle that is drawn as a line


class Kind(Enum):
    """How a shape is drawn."""

    ARROW = "arrow"  # along the x axis; size: length, width, height
    BOX = "box"
    DISC = "disc"  # flat, with the diameters size[0] and size[1]
    LINE = "line"  # through ``points``; size[0]: its width
    TEXT = "text"  # turned to the viewer; size[2]: height of a capital letter


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """One thing on the map.

    ``group`` and ``name`` together name it from frame to frame. position : m in ``map``; yaw_rad :
    counter-clockwise from east; size : m along its own axes; points : (n, 3) m in ``map``.
    """

    group: str
    name: str
    kind: Kind
    colour: Colour
    size: tuple[float, float, float]
    position: tuple[float, float, float] = ORIGIN
    yaw_rad: float = 0.0
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    text: str = ""

    @property
    def key(self) -> tuple[str, str]:
        """Group and name."""
        return self.group, self.name


def circle(centre: tuple[float, float, float], radius_m: float) -> Array:
    """(n, 3) points of a closed horizontal circle; the last one is the first."""
    angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    ring = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
    points: Array = np.asarray(centre) + radius_m * ring
    points[-1] = points[0]
    return points


def ellipse_axes(cov: Array, scale: float) -> tuple[float, float, float]:
    """Semi-axes [m], the larger first, and the angle [rad] of the larger one from east.

    cov : (2, 2) m^2; scale : semi-axes over standard deviations
    """
    variances, directions = np.linalg.eigh(cov)
    minor, major = scale * np.sqrt(np.maximum(variances, 0.0))
    return float(major), float(minor), float(np.arctan2(directions[1, 1], directions[0, 1]))


class Numbers:
    """Gives each shape a small number, which it keeps while it exists; then the number is free.

    Viewers name a shape by its group and a number.
    """

    def __init__(self) -> None:
        self._numbers: dict[tuple[str, str], int] = {}
        self._free: dict[str, list[int]] = {}
        self._used: dict[str, int] = {}

    def frame(
        self, shapes: Iterable[Shape]
    ) -> tuple[list[tuple[int, Shape]], list[tuple[int, str]]]:
        """Shapes with their numbers; number and group of those that were there and are gone."""
        shown = {shape.key: shape for shape in shapes}
        gone = []
        for key in [key for key in self._numbers if key not in shown]:
            number = self._numbers.pop(key)
            self._free.setdefault(key[0], []).append(number)
            gone.append((number, key[0]))
        # A number that became free in this frame may be given again: a viewer that takes
        # deletions first shows the new shape.
        return [(self._number(key), shape) for key, shape in shown.items()], gone

    def _number(self, key: tuple[str, str]) -> int:
        if key not in self._numbers:
            free = self._free.get(key[0])
            if free:
                self._numbers[key] = free.pop()
            else:
                self._numbers[key] = self._used.get(key[0], 0)
                self._used[key[0]] = self._numbers[key] + 1
        return self._numbers[key]
