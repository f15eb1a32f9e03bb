"""Antenna arrays and the Cramér-Rao bound of the direction of arrival.

Elements are isotropic. Everything the bound needs of an array is the mean second moment of its
element positions, ``M = 1/N sum p p^T`` about their centroid, in wavelengths squared."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

Array = npt.NDArray[np.float64]


@dataclass(
    frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
)
class AntennaArray:
    """A regular array in the RSU's axes (x boresight, y left, z up).

    planar: ``rows`` x ``columns`` in the y-z plane. Its azimuth bound grows as 1/cos(azimuth) off
    boresight, and it cannot tell front from back, so it serves ``field_of_view_deg`` (full angle,
    below 180) only. cylindrical: ``columns`` elements evenly round the z axis,
    ``spacing_wavelengths`` apart along the circumference, in ``rows`` rings. With three columns or
    more M is diag(r^2/2, r^2/2, .), so the azimuth bound is the same in all directions; it serves
    360 degrees."""

    kind: Literal["planar", "cylindrical"] = "planar"
    rows: int = Field(default=8, ge=1)
    columns: int = Field(default=8, ge=2)
    spacing_wavelengths: float = Field(default=0.5, gt=0, le=0.5)
    field_of_view_deg: float = Field(default=120.0, gt=0, lt=180)

    def __post_init__(self) -> None:
        if self.kind == "cylindrical" and self.columns < 3:
            raise ValueError(f"a cylindrical array needs at least 3 columns, got {self.columns}")

    @property
    def elements(self) -> Array:
        """(N, 3) element positions about their centroid [wavelengths]."""
        gap = self.spacing_wavelengths
        z = gap * (np.arange(self.rows) - (self.rows - 1) / 2)
        if self.kind == "planar":
            y = gap * (np.arange(self.columns) - (self.columns - 1) / 2)
            ring = np.column_stack([np.zeros_like(y), y])
        else:
            angle = 2 * np.pi * np.arange(self.columns) / self.columns
            ring = (
                gap * self.columns / (2 * np.pi) * np.column_stack([np.cos(angle), np.sin(angle)])
            )
        return np.hstack([np.tile(ring, (self.rows, 1)), np.repeat(z, self.columns)[:, None]])

    @property
    def count(self) -> int:
        """Number of elements N."""
        return self.rows * self.columns

    @property
    def half_view_rad(self) -> float:
        """Largest azimuth off boresight that is served; pi: all."""
        return math.pi if self.kind == "cylindrical" else math.radians(self.field_of_view_deg / 2)

    def second_moment(self) -> Array:
        """(3, 3) M [wavelengths^2]."""
        p = self.elements
        return np.asarray(p.T @ p / len(p))


def direction_slopes(azimuth_rad: float, elevation_rad: float) -> Array:
    """(2, 3) derivatives of the unit vector towards (azimuth, elevation) by azimuth and by
    elevation."""
    ca, sa = math.cos(azimuth_rad), math.sin(azimuth_rad)
    ce, se = math.cos(elevation_rad), math.sin(elevation_rad)
    return np.array([[-sa * ce, ca * ce, 0.0], [-ca * se, -sa * se, ce]])


def direction_bound(
    array: AntennaArray, snr: float, azimuth_rad: float, elevation_rad: float | None = None
) -> Array:
    """Cramér-Rao bound of the direction for one path of unknown amplitude and phase.

    ``snr`` is the signal-to-noise energy ratio summed over all elements, pilots and symbols. The
    Fisher information is ``2 snr (2 pi)^2 D M D^T`` with D of ``direction_slopes``; amplitude and
    phase decouple because M is taken about the centroid. Returns (2, 2) for azimuth and elevation,
    or (1, 1) for the azimuth alone (elevation known, 0) when no elevation is given."""
    if not snr > 0:
        raise ValueError(f"snr must be > 0 (linear), got {snr}")
    slopes = direction_slopes(azimuth_rad, elevation_rad or 0.0)
    if elevation_rad is None:
        slopes = slopes[:1]
    fisher = 2 * snr * (2 * np.pi) ** 2 * slopes @ array.second_moment() @ slopes.T
    return np.asarray(np.linalg.inv(fisher))
