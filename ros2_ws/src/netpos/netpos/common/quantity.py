"""A figure as text with its unit."""

from __future__ import annotations


def quantity(value: float, unit: str) -> str:
    """A figure with its unit; seconds with a suitable prefix."""
    if unit == "s":
        for limit, factor, name in ((1e-3, 1e6, "µs"), (1.0, 1e3, "ms")):
            if abs(value) < limit:
                return f"{value * factor:.3g} {name}"
    return f"{value:.4g} {unit}".rstrip()
