"""Step length: two models, and the scale of the person, calibrated online.

``frequency``: people of height H who make F steps per second walk steps of

    L = 0.7 + 0.371 (H - 1.75) + 0.227 (F - 1.79) H / 1.75                               (L1)

R. Chen, L. Pei, Y. Chen, "A smart phone based PDR solution for indoor navigation", ION GNSS 2011.
``weinberg``: L = k (a_max - a_min)^(1/4), H. Weinberg, Analog Devices AN-602, 2002        (L2)

The length of a person's steps is either times a scale s, whose mean and variance ``LengthScale``
keeps: a scalar Kalman filter of reference displacements z = s h + noise.
"""

from __future__ import annotations

import math
from typing import Literal

LengthModel = Literal["frequency", "weinberg"]

SHORTEST_M = 0.2  # of a step at any cadence


def frequency_length(cadence_hz: float, height_m: float) -> float:
    """Step length [m] of a walker of ``height_m`` at a cadence > 0 (L1), at least 0.2 m."""
    swing = 0.227 * (cadence_hz - 1.79) * height_m / 1.75
    return max(0.7 + 0.371 * (height_m - 1.75) + swing, SHORTEST_M)


def weinberg_length(range_mps2: float, k: float) -> float:
    """Step length [m] of a range [m/s^2] >= 0 and k [m (m/s^2)^(-1/4)] (L2)."""
    return k * math.sqrt(math.sqrt(max(range_mps2, 0.0)))


class LengthScale:
    """True over modelled step length of one person: mean and variance."""

    def __init__(self, mean: float = 1.0, sd: float = 0.1) -> None:
        self.mean, self.var = mean, sd * sd

    @property
    def sd(self) -> float:
        return math.sqrt(self.var)

    def observe(self, modelled_m: float, reference_m: float, reference_var: float) -> None:
        """Fuse a reference of some steps.

        modelled_m : what the steps amount to with the scale 1: their length along the walked
            way, or sum of L cos(angle to the anchor) for a difference of two ranges
        reference_m : the same from outside: a displacement, or the fall of the range
        reference_var : its variance [m^2], > 0; errors must not come from the steps themselves

        Raises
        ------
        ValueError  a value is not finite, or the variance is not > 0
        """
        if not (math.isfinite(modelled_m) and math.isfinite(reference_m)):
            raise ValueError(
                f"a reference displacement must be finite, got {modelled_m} and {reference_m} m"
            )
        if not 0 < reference_var < math.inf:
            raise ValueError(
                f"reference_var must be finite and > 0, got {reference_var}; give the variance "
                "of the displacement in m^2"
            )
        innovation_var = modelled_m**2 * self.var + reference_var
        gain = self.var * modelled_m / innovation_var
        self.mean += gain * (reference_m - modelled_m * self.mean)
        self.var *= reference_var / innovation_var
