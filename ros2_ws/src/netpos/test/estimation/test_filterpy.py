"""The compiled EKF against FilterPy over a whole simulated track (fokin2020's fast pass)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import VALUE, VARIANCE, linearise
from netpos.estimation.motion import (
    NO_BIAS,
    SPEED_OF_LIGHT_MPS,
    ProcessNoise,
    motion_parameters,
    noise,
    transition,
)
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement

T = 0.1
RSUS = tuple(
    RsuInfo(rsu_id=f"rsu_{i}", position=np.array([60.0 * i, 10.0, 0.0])) for i in range(2)
)
# FilterPy inverts S: its first update of a clock known to 100 us is off by 1e-6 m (the compiled
# one by 1e-10 m, see test_ekf), so agreement is relative to the width of that prior.
STATE_SCALE = 3e4
DOA_SD, TOA_SD = math.radians(2.0), 50e-9


def measurements(rng: np.random.Generator, x: Array) -> list[RsuMeasurement]:
    out = []
    for rsu in RSUS:
        d = x[POSITION] - rsu.position[:2]
        out.append(
            RsuMeasurement(
                stamp_ns=1,
                rsu_id=rsu.rsu_id,
                vue_id="vue_1",
                fields=Field.AZIMUTH | Field.TOA,
                azimuth_rad=math.atan2(d[1], d[0]) + rng.normal() * DOA_SD,
                azimuth_var=DOA_SD**2,
                toa_s=(math.hypot(*d) + x[X.CLOCK]) / SPEED_OF_LIGHT_MPS + rng.normal() * TOA_SD,
                toa_var=TOA_SD**2,
            )
        )
    return out


def h_of(x: Array) -> Array:
    """Rows in the order DOA 1, TOA 1, DOA 2, TOA 2: fokin2020:eq.41-42."""
    out = []
    for rsu in RSUS:
        d = x[POSITION, 0] - rsu.position[:2]
        out += [math.atan2(d[1], d[0]), math.hypot(*d) + x[X.CLOCK, 0]]
    return np.array(out)[:, None]


def jacobian_of(x: Array) -> Array:
    """fokin2020:eq.44."""
    H = np.zeros((4, 6))
    for i, rsu in enumerate(RSUS):
        dx, dy = x[POSITION, 0] - rsu.position[:2]
        d2 = dx * dx + dy * dy
        H[2 * i, :2] = -dy / d2, dx / d2
        H[2 * i + 1, :2] = np.array([dx, dy]) / math.sqrt(d2)
        H[2 * i + 1, 4] = 1.0
    return H


def residual(a: Array, b: Array) -> Array:
    y = a - b
    y[0::2] = np.remainder(y[0::2] + np.pi, 2 * np.pi) - np.pi
    return y


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", list(ProcessNoise))
def test_whole_track_equals_filterpy(kind: ProcessNoise, seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion = motion_parameters(
        noise=kind,
        accel=1.0,
        velocity_step=0.1,
        offset_density=1e-2,
        drift_density=0.1,
        drift_step=1e-4 * SPEED_OF_LIGHT_MPS,
    )
    F, Q, work = np.empty((6, 6)), np.empty((6, 6)), ekf.workspace(6, 4)
    transition(np.zeros(6), T, motion, NO_BIAS, F)
    noise(np.zeros(6), T, motion, NO_BIAS, Q)
    truth = np.array([-30.0, 0.0, 20.0, 0.3, 6000.0, 7500.0])
    x = np.array([-27.0, 2.0, 0.0, 0.0, 0.0, 7500.0])
    P = np.diag([25.0, 25.0, 200.0, 25.0, 3e4**2, 9e3**2])
    reference = ExtendedKalmanFilter(dim_x=6, dim_z=4)
    reference.x, reference.P, reference.F, reference.Q = x[:, None].copy(), P.copy(), F, Q
    axes = [rsu_axes(r) for r in RSUS]
    for _ in range(60):
        truth = F @ truth
        rows = np.vstack(
            [rsu_rows(m, RSUS[i], axes[i], i) for i, m in enumerate(measurements(rng, truth))]
        )
        ekf.predict(x, P, T, motion, NO_BIAS)
        reference.predict()
        innovation, H = linearise(rows, x, 0.0)
        ekf.fuse(x, P, innovation, H, rows[:, VARIANCE].copy(), np.ones(4), work)
        z, R = rows[:, VALUE][:, None], np.diag(rows[:, VARIANCE])
        reference.update(z, jacobian_of, h_of, R=R, residual=residual)
        assert np.abs(x - reference.x[:, 0]).max() < 1e-9 * STATE_SCALE
        scale = np.maximum(np.abs(reference.x[:, 0]), np.sqrt(np.diag(reference.P)))
        np.testing.assert_array_less(np.abs(x - reference.x[:, 0]) / scale, 1e-7)
        correlation_scale = np.sqrt(np.outer(np.diag(reference.P), np.diag(reference.P)))
        np.testing.assert_array_less(np.abs(P - reference.P) / correlation_scale, 1e-7)
    assert math.hypot(*(x - truth)[:2]) < 5.0


def test_nis_equals_filterpys() -> None:
    """Squared Mahalanobis distance of the whole epoch; FilterPy 1.4 had it wrong, 2.0 is right."""
    rng = np.random.default_rng(5)
    x, P = np.array([-27.0, 2.0, 20.0, 0.0, 6000.0, 7500.0]), np.diag([25.0, 25, 1, 1, 400, 1])
    reference = ExtendedKalmanFilter(dim_x=6, dim_z=4)
    reference.x, reference.P = x[:, None].copy(), P.copy()
    rows = np.vstack(
        [
            rsu_rows(m, r, rsu_axes(r), i)
            for i, (m, r) in enumerate(zip(measurements(rng, x), RSUS, strict=True))
        ]
    )
    innovation, H = linearise(rows, x, 0.0)
    variance = rows[:, VARIANCE].copy()
    nis = ekf.group_nis(P, innovation, H, variance)
    fused = ekf.fuse(x.copy(), P.copy(), innovation, H, variance, np.ones(4), ekf.workspace(6, 4))
    reference.update(
        rows[:, VALUE][:, None], jacobian_of, h_of, R=np.diag(rows[:, VARIANCE]), residual=residual
    )
    assert nis == pytest.approx(reference.mahalanobis**2, rel=1e-9)
    assert fused == pytest.approx(reference.mahalanobis**2, rel=1e-9)
