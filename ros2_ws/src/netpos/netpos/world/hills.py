"""Height of a road over time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Hills:
    """Height of a road: a sine in time; a body on it pitches with the slope. Amplitude 0: flat."""

    amplitude_m: float = 0.0
    period_s: float = 180.0

    def __post_init__(self) -> None:
        if not 0 <= self.amplitude_m < math.inf:
            raise ValueError(f"amplitude_m must be finite and >= 0, got {self.amplitude_m}")
        if not 0 < self.period_s < math.inf:
            raise ValueError(f"period_s must be finite and > 0, got {self.period_s}")

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Height [m], climb [m/s] and its rate [m/s^2] at times (n,) [s]."""
        rate = 2 * math.pi / self.period_s
        sine, cosine = np.sin(rate * time_s), np.cos(rate * time_s)
        a = self.amplitude_m
        return a * sine, a * rate * cosine, -a * rate**2 * sine


FLAT = Hills()
