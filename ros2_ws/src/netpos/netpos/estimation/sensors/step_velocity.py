"""The velocity dead reckoning reports of a person whose steps are longer than its model says and
whose heading is turned against the map:

    u = exp(-k) R(-a) v

v the true velocity in map, k the logarithm of true over modelled step length, a the angle from
reported to true heading. Either may be missing: state index -1, value 0. A row is one of a
decorrelated velocity (``rows.linear_rows``): g u, g in the entries of H that belong to v; BIAS and
COMMON are the state indices of k and a.
"""

from __future__ import annotations

import math

import numpy as np

from netpos.estimation.compile import kernel, leaf
from netpos.estimation.sensors.model import Sensor
from netpos.estimation.sensors.row import BIAS, COMMON, ORIGIN
from netpos.estimation.state import X
from netpos.messages.values import Array


@leaf
def _state(mean: Array, index: int) -> float:
    return float(mean[index]) if index >= 0 else 0.0


@leaf
def reported(row: Array, mean: Array, h: Array) -> float:
    """g u at ``mean`` (n,), whose velocity is v; its gradient there is added to ``h`` (n,)."""
    gx, gy, length, heading = (
        row[ORIGIN + X.VX],
        row[ORIGIN + X.VY],
        int(row[BIAS]),
        int(row[COMMON]),
    )
    scale, angle = math.exp(-_state(mean, length)), _state(mean, heading)
    c, s = scale * math.cos(angle), scale * math.sin(angle)
    h[X.VX] += gx * c - gy * s
    h[X.VY] += gx * s + gy * c
    ux, uy = c * mean[X.VX] + s * mean[X.VY], c * mean[X.VY] - s * mean[X.VX]
    value = gx * ux + gy * uy
    if length >= 0:
        h[length] -= value
    if heading >= 0:
        h[heading] += gx * uy - gy * ux
    return float(value)


@kernel
def exact(row: Array, mean: Array, cov: Array) -> float:
    """Half the trace of (h'' P)^2 of ``reported`` at ``mean`` (n,) under ``cov`` (n, n)."""
    h, length, heading = np.zeros(mean.size), int(row[BIAS]), int(row[COMMON])
    value = reported(row, mean, h)
    index = (X.VX.value, X.VY.value, length, heading)
    second, P = np.zeros((4, 4)), np.zeros((4, 4))
    second[0, 2], second[1, 2], second[2, 2] = -h[X.VX], -h[X.VY], value
    second[0, 3], second[1, 3], second[3, 3] = -h[X.VY], h[X.VX], -value
    second[2, 3] = -h[heading] if heading >= 0 else 0.0
    for a in range(4):
        for b in range(4):
            second[max(a, b), min(a, b)] = second[min(a, b), max(a, b)]
            if index[a] >= 0 and index[b] >= 0:
                P[a, b] = cov[index[a], index[b]]
    spread = second @ P
    return 0.5 * float((spread * spread.T).sum())


SENSOR = Sensor(
    name="STEP_VELOCITY",
    kind=10,
    of_state=reported,
    second_order=exact,
    adds_biases=False,
)
