"""A start and an opened velocity, for the tests of the compiled epoch."""

from __future__ import annotations

import numpy as np
from netpos.messages.values import Array


def opened(cov: Array, sd: float, unheard_s: float) -> Array:
    """A velocity step of ``sd`` at a time in the past: G G' sd^2 with G = [s, 1] per axis."""
    out = cov.copy()
    for p in (0, 1):
        g = np.zeros(len(cov))
        g[p], g[p + 2] = sd * unheard_s, sd
        out += np.outer(g, g)
    return out


def start(speed: float = 8.0) -> tuple[Array, Array]:
    mean = np.array([20.0, 0.0, speed, 0.0, 10.0, 0.0])
    A = np.random.default_rng(5).normal(size=(6, 6))
    scale = np.array([1.0, 1.0, 0.5, 0.5, 2.0, 0.5])
    return mean, np.outer(scale, scale) * (0.2 * A @ A.T / 6 + np.eye(6))
