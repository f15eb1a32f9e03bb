"""Hard and soft iron of a magnetometer from readings in many orientations.

Readings of a constant field b turned every way lie on an ellipsoid: m = (I + S) b + h. Its centre
is the hard iron h; the symmetric matrix that makes it a sphere undoes the soft iron S but for a
common factor, which keeps the mean size of the field. The ellipsoid is the algebraic least-squares
fit of

    x' Q x + 2 q' x = 1                                                            (M1)

(Q. Li and J. G. Griffiths, "Least squares ellipsoid specific fitting", GMP 2004; V. Renaudin,
M. H. Afzal, G. Lachapelle, "Complete triaxis magnetometer calibration in the magnetic domain",
J. Sensors 2010), in coordinates scaled to unit spread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MIN_SAMPLES = 20
MAX_CONDITION = 1e3  # of the scaled normal matrix: below it all three axes were turned through


@dataclass(frozen=True, slots=True, eq=False)
class MagneticCalibration:
    """b = matrix (m - offset). offset (3,) T, matrix (3, 3); residual_sd: of |b| over its mean."""

    offset: Array
    matrix: Array
    residual_sd: float

    def apply(self, field: npt.ArrayLike) -> Array:
        """Calibrated field (..., 3) [T] of readings (..., 3)."""
        return np.asarray((np.asarray(field) - self.offset) @ self.matrix.T)


def fit_iron(field: npt.ArrayLike) -> MagneticCalibration:
    """Calibrate on readings (n, 3) [T] taken in one place while turning every way (M1).

    Raises
    ------
    ValueError  fewer than 20 readings, readings not finite, or orientations that do not show all
        axes (a device that only turned about the vertical)
    """
    m = np.asarray(field, dtype=np.float64)
    if m.ndim != 2 or m.shape[1] != 3 or len(m) < MIN_SAMPLES or not np.isfinite(m).all():
        raise ValueError(
            f"a calibration needs at least {MIN_SAMPLES} finite readings (n, 3), got {m.shape}"
        )
    middle, sd = m.mean(axis=0), float(m.std())
    if not sd > 0:
        raise ValueError("all readings are the same; turn the device through all orientations")
    x, y, z = ((m - middle) / sd).T
    design = np.column_stack(
        [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z]
    )
    condition = float(np.linalg.cond(design / np.linalg.norm(design, axis=0)))
    p = np.linalg.lstsq(design, np.ones(len(m)), rcond=None)[0]
    quadric = np.array([[p[0], p[3], p[4]], [p[3], p[1], p[5]], [p[4], p[5], p[2]]])
    values, vectors = np.linalg.eigh(quadric)
    if condition > MAX_CONDITION or not values[0] > 0:
        raise ValueError(
            "the readings do not show all axes of the ellipsoid; turn the device through all "
            "orientations, not about the vertical alone"
        )
    centre = -np.linalg.solve(quadric, p[6:])
    radius = math.sqrt(1.0 + float(centre @ quadric @ centre))
    size = radius * sd / math.exp(float(np.mean(np.log(values))) / 2)  # geometric mean axis
    matrix = (vectors * np.sqrt(values)) @ vectors.T * (size / (radius * sd))
    offset = middle + sd * centre
    norms = np.linalg.norm((m - offset) @ matrix.T, axis=1)
    return MagneticCalibration(offset, matrix, float(norms.std() / norms.mean()))
