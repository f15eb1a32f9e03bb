"""The problem every filter of the benchmark solves: a device passes two RSUs that measure DOA and
TOA (fokin2020 Fig. 5), state x y vx vy clock drift."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from netpos.estimation.measurement import VARIANCE, curvature_mean, curvature_variance
from netpos.estimation.motion import (
    NO_BIAS,
    SPEED_OF_LIGHT_MPS,
    motion_parameters,
    noise,
    transition,
)
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement

DT_S = 0.1
HEIGHT_M = 0.0
ROWS = 4
MOTION = motion_parameters(accel=1.0, offset_density=0.03, drift_density=3.0)
_RSUS = (
    RsuInfo(rsu_id="west", position=np.array([0.0, 15.0, 8.0])),
    RsuInfo(rsu_id="east", position=np.array([120.0, -15.0, 8.0])),
)
_SPEED_MPS = 1.0
_DOA_SD = math.radians(2.0)
_TOA_SD_S = 5e-9


@dataclass(frozen=True, slots=True)
class Problem:
    """mean (6,), cov (6, 6) before the first epoch; rows (epochs, 4, ROW_WIDTH)."""

    mean: Array
    cov: Array
    rows: Array

    @property
    def epochs(self) -> int:
        """Number of epochs."""
        return len(self.rows)


def problem(epochs: int, seed: int = 1) -> Problem:
    """A walk to and fro between the RSUs, one epoch every ``DT_S``."""
    rng = np.random.default_rng(seed)
    offset_m, drift_mps = 100.0, 10.0
    rows = np.stack(
        [_epoch((k + 1) * DT_S, offset_m + drift_mps * (k + 1) * DT_S, rng) for k in range(epochs)]
    )
    x, y = _position(0.0)
    mean = np.array([x, y, _SPEED_MPS, 0.0, offset_m, drift_mps])
    sd = np.array([2.0, 2.0, 1.0, 1.0, 10.0, 5.0])
    return Problem(mean + 0.5 * sd, np.diag(sd**2), rows)


def _position(time_s: float) -> tuple[float, float]:
    """40 m to 80 m east and back, on a line north of neither RSU: angles stay off +-pi."""
    phase = (_SPEED_MPS * time_s) % 80.0
    return 40.0 + (phase if phase < 40.0 else 80.0 - phase), 0.0


def _epoch(time_s: float, clock_m: float, rng: np.random.Generator) -> Array:
    x, y = _position(time_s)
    blocks = []
    for group, info in enumerate(_RSUS):
        dx, dy, dz = x - info.position[0], y - info.position[1], HEIGHT_M - info.position[2]
        distance_m = math.sqrt(dx * dx + dy * dy + dz * dz)
        measurement = RsuMeasurement(
            stamp_ns=1,
            rsu_id=info.rsu_id,
            vue_id="vue_1",
            fields=Field.AZIMUTH | Field.TOA,
            azimuth_rad=math.atan2(dy, dx) + _DOA_SD * rng.standard_normal(),
            azimuth_var=_DOA_SD**2,
            toa_s=(distance_m + clock_m) / SPEED_OF_LIGHT_MPS + _TOA_SD_S * rng.standard_normal(),
            toa_var=_TOA_SD_S**2,
        )
        blocks.append(rsu_rows(measurement, info, rsu_axes(info), group))
    return np.vstack(blocks)


def model() -> tuple[Array, Array]:
    """F (6, 6) and Q (6, 6) of one step; the model is linear and the same at every state."""
    F, Q = np.empty((6, 6)), np.empty((6, 6))
    transition(np.zeros(6), DT_S, MOTION, NO_BIAS, F)
    noise(np.zeros(6), DT_S, MOTION, NO_BIAS, Q)
    return F, Q


def bends(rows: Array, mean: Array, cov: Array) -> Array:
    """How far the mean of each row (4,) of an epoch is above its value at ``mean``."""
    return np.array([curvature_mean(r, mean, cov, HEIGHT_M) for r in rows])


def variances(rows: Array, mean: Array, cov: Array) -> Array:
    """Variance (4,) of each row of an epoch with what linearising at ``mean`` leaves out."""
    return np.array([r[VARIANCE] + curvature_variance(r, mean, cov, HEIGHT_M) for r in rows])
