"""What is learned of the errors of an RSU, in words."""

from __future__ import annotations

import math

from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.messages.values import RsuErrors

_SURE = 3.0  # sd of a bias that is mentioned
_SCATTERS = 1.5  # times as stated, or less than one over it
_LENGTHS = {"RANGE": "ranges", "TDOA": "time differences"}


def words(errors: RsuErrors) -> str:
    """A phrase for each quantity that is not as stated: "ranges 0.12 m long, scatter 3.1 times as
    stated"; empty where all are."""
    found = []
    for quantity, scatter, bias, sd in zip(
        errors.quantities, errors.scatter, errors.bias, errors.bias_sd, strict=True
    ):
        said = []
        if abs(bias) > _SURE * sd:
            said.append(_off(quantity, bias))
        if not 1.0 / _SCATTERS < scatter < _SCATTERS:
            said.append(f"scatter {scatter:.1f} times as stated")
        if said:
            name = _LENGTHS.get(quantity, quantity.lower())
            found.append(f"{name} {', '.join(said)}")
    return "; ".join(found)


def _off(quantity: str, bias: float) -> str:
    if quantity in _LENGTHS:
        return f"{abs(bias):.2f} m {'long' if bias > 0.0 else 'short'}"
    if quantity == "TOA":
        late = "late" if bias > 0.0 else "early"
        return f"{abs(bias) / SPEED_OF_LIGHT_MPS * 1e9:.1f} ns {late}"
    if quantity.startswith("COSINE"):
        return f"off by {bias:.3f}"
    return f"off by {math.degrees(bias):.1f} deg"
