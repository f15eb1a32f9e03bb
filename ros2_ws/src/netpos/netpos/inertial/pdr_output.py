"""What dead reckoning puts out: steps, and the velocity of the last step with its covariance.

Petukhov et al. (``petukhov``): the velocity of a step of length L, duration T and heading psi
(eq. 6, here with psi counter-clockwise from east) and its propagated covariance (eqs. 7-8,
completed by the off-diagonal term they leave out):

    v = (L / T) (cos psi, sin psi)                                              (petukhov:6)
    J = [[cos psi / T, -|v| sin psi], [sin psi / T, |v| cos psi]]
    C = J diag(sd_L^2, sd_psi^2) J^T                                            (petukhov:7-8)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from netpos.inertial.attitude import HeadingReference

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StepEvent:
    """A step between the initial contacts ``start_ns`` and ``end_ns``.

    stamp_ns : the IMU sample that revealed it; the steps that open a bout share one
    count : 1 for the first step since construction
    heading_rad : walking direction, counter-clockwise from map x, [-pi, pi)
    heading_reference : "map" (x is east) or "relative" (x is the first body heading)
    """

    stamp_ns: int
    start_ns: int
    end_ns: int
    count: int
    length_m: float
    heading_rad: float
    heading_sd_rad: float
    length_sd_m: float
    cadence_hz: float
    heading_reference: HeadingReference


@dataclass(frozen=True, slots=True, eq=False)
class StepVelocity:
    """Horizontal velocity at ``stamp_ns``, the stamp of the IMU sample that produced it.

    velocity : (2,) m/s along map x, y: east and north when ``heading_reference`` is "map"
    covariance : (2, 2) m^2/s^2, symmetric positive definite
    moving : False only for the tight zero of stillness; True with zero velocity and a wide
        covariance while the state is undecided
    """

    stamp_ns: int
    velocity: Array
    covariance: Array
    moving: bool
    heading_reference: HeadingReference


@dataclass(frozen=True, slots=True)
class PdrOutput:
    """What one IMU sample produced: the steps it revealed and, at a tick, the velocity."""

    steps: tuple[StepEvent, ...]
    velocity: StepVelocity | None


def step_velocity(
    length_m: float,
    duration_s: float,
    heading_rad: float,
    length_sd_m: float,
    heading_sd_rad: float,
) -> tuple[Array, Array]:
    """Mean velocity of a step and its covariance (petukhov:6-8).

    Returns
    -------
    velocity (2,) m/s, covariance (2, 2) m^2/s^2; the duration counts as exact

    Raises
    ------
    ValueError  the duration is not positive
    """
    if not duration_s > 0:
        raise ValueError(f"step duration must be > 0 s, got {duration_s}")
    speed, c, s = length_m / duration_s, math.cos(heading_rad), math.sin(heading_rad)
    jacobian = np.array([[c / duration_s, -speed * s], [s / duration_s, speed * c]])
    cov = jacobian @ np.diag([length_sd_m**2, heading_sd_rad**2]) @ jacobian.T
    return np.array([speed * c, speed * s]), (cov + cov.T) / 2
