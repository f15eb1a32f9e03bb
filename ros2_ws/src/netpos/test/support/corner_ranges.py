"""Ranges of four RSUs at the corners of a square, for the tests of the baselines."""

from __future__ import annotations

import numpy as np
from netpos.evaluation.yardsticks import (
    Observations,
    Space,
    ranges,
)
from netpos.messages.values import Array

S = 1_000_000_000
SQUARE = np.array([[0.0, 0.0, 3.0], [20.0, 0.0, 3.0], [20.0, 20.0, 3.0], [0.0, 20.0, 3.0]])
LEVEL = Space(height_m=1.0)


def at_rest(place: Array, sd: float, seconds: int, rng: np.random.Generator) -> Observations:
    """Ranges of the four corners, together, 10 times a second."""
    stamps = np.repeat(S + np.arange(10 * seconds) * (S // 10), 4)
    sites = np.tile(SQUARE, (10 * seconds, 1))
    true = np.linalg.norm(place - sites, axis=1)
    return ranges(stamps, sites, true + sd * rng.standard_normal(len(true)), sd)
