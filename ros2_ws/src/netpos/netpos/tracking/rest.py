"""Whether a device rests, by what is said or estimated of its velocity."""

from __future__ import annotations

from collections.abc import Iterable


def rests(velocity: Iterable[float], variances: Iterable[float]) -> bool:
    """Whether a velocity [m/s], one value an axis, is no larger than its standard deviation;
    ``variances`` [m^2/s^2], one an axis. A device that rests has an estimated velocity, too."""
    return sum(v * v for v in velocity) <= sum(variances)
