"""How the error-state filter cuts time into chunks, and what it does without samples."""

from __future__ import annotations

import numpy as np
import pytest
from error_states import NOISE, driven, moving
from netpos.estimation.spatial.error_state import (
    BLIND,
    LAST,
    MEMORY,
    UNCONSTRAINED,
    Chunk,
    Constraints,
    Imu,
    Sensors,
    SlowErrors,
    advance,
    predict_chunk,
)
from netpos.estimation.state import NAV_POSITION, NAV_QUATERNION, NAV_VELOCITY, Err
from netpos.inertial.strapdown import (
    ACCEL_BIAS,
    ERR,
    GYRO_BIAS,
    NAV,
    InertialNoise,
    propagate,
    still_earth,
)
from netpos.messages.values import Array
from scipy.spatial.transform import Rotation

SENSORS = Sensors(NOISE, still_earth(), UNCONSTRAINED)
MS = 1_000_000


def resting() -> Array:
    nav = np.zeros(NAV)
    nav[:6] = 1.0, 2.0, 3.0, 4.0, -2.0, 0.5
    nav[NAV_QUATERNION] = Rotation.from_euler("ZYX", [0.7, 0.2, -0.3]).as_quat()
    nav[10:] = 0.02, -0.01, 0.03, 1e-3, -2e-3, 1e-3
    return nav


def chunk_of(
    stamps_ms: list[int], rates: Array, from_ms: int, to_ms: int
) -> tuple[float, float, Array, Array]:
    """End [ms] and time without samples [ms] of one chunk, its means and length, and the memory
    of increments after it."""
    memory, chunk = np.full(MEMORY, 7.0), np.full(7, np.nan)
    imu = Imu(np.array(stamps_ms, dtype=np.int64) * MS, rates)
    end, blind_s = predict_chunk(
        resting(), np.eye(ERR), memory, from_ms * MS, to_ms * MS, imu, SENSORS,
        Chunk(chunk, np.full((ERR, ERR), np.nan)),
    )  # fmt: skip
    return end / MS, blind_s * 1e3, chunk, memory[:LAST]


def means(stamps_ms: list[int], rates: Array, from_ms: int, to_ms: int) -> Array:
    """Mean of what was measured, summed up millisecond by millisecond: a sample holds up to its
    stamp, the last one on."""
    index = [
        min(np.searchsorted(stamps_ms, t + 0.5), len(rates) - 1) for t in range(from_ms, to_ms)
    ]
    mean: Array = rates[index].mean(axis=0)
    return mean


@pytest.mark.parametrize(
    ("stamps_ms", "from_ms", "to_ms", "end_ms", "blind_ms"),
    [
        (list(range(10, 300, 10)), 0, 1000, 100, 0),
        (list(range(10, 300, 10)), 5, 1000, 110, 0),  # the sample that fills the 0.1 s
        (list(range(10, 300, 10)), 10, 1000, 110, 0),
        (list(range(10, 300, 10)), 0, 77, 77, 0),
        ([*range(10, 51, 10), *range(100, 300, 10)], 0, 1000, 100, 0),  # 50 ms are no hole
        ([*range(10, 51, 10), *range(101, 300, 10)], 0, 1000, 101, 51),  # 51 ms are one
        ([*range(10, 51, 10), *range(101, 300, 10)], 0, 80, 80, 30),
        ([*range(10, 51, 10), *range(101, 300, 10)], 60, 1000, 161, 41),
        ([10, 20, 30, 400, 410], 30, 1000, 130, 100),  # a long hole is cut
        ([10, 20, 30, 400, 410], 0, 1000, 130, 100),
        ([10, 20, 30], 30, 1000, 130, 100),  # and so is what follows the last sample
        ([10, 20, 30], 10, 1000, 130, 100),
        ([50, 60, 70, 80, 90, 100], 0, 1000, 100, 0),  # the first sample reaches back 50 ms
        ([51, 60, 70, 80, 90, 100], 0, 1000, 100, 51),
        ([1050, 1060, 1070, 1080, 1090, 1100], 1000, 2000, 1100, 0),  # from any begin
        ([300, 310], 0, 1000, 100, 100),
    ],
)
def test_a_chunk_ends_with_the_sample_that_fills_it(
    stamps_ms: list[int], from_ms: int, to_ms: int, end_ms: int, blind_ms: int
) -> None:
    rates = np.random.default_rng(1).normal(size=(len(stamps_ms), 6))
    end, blind, chunk, _ = chunk_of(stamps_ms, rates, from_ms, to_ms)
    assert (end, blind) == (end_ms, pytest.approx(blind_ms, abs=1e-9))
    np.testing.assert_allclose(chunk[:6], means(stamps_ms, rates, from_ms, end_ms), rtol=1e-12)
    assert chunk[6] == pytest.approx((end_ms - from_ms) * 1e-3, rel=1e-12)


def test_what_was_measured_before_a_hole_says_nothing_after_it() -> None:
    """The last increments, with which coning is compensated, are those since the hole."""
    rates = np.random.default_rng(1).normal(size=(3, 6))
    assert chunk_of([10, 20, 30], rates, 0, 30)[3].any()
    np.testing.assert_array_equal(chunk_of([10, 20, 30], rates, 0, 1000)[3], 0.0)


@pytest.mark.parametrize("samples", [0, 1])
def test_without_samples_a_tilted_vehicle_goes_on_as_it_was(samples: int) -> None:
    """Its attitude turns by what the last sample says, here by nothing."""
    nav = resting()
    before, C = nav.copy(), Rotation.from_quat(nav[NAV_QUATERNION])
    level = np.concatenate(
        [nav[GYRO_BIAS:NAV], nav[ACCEL_BIAS:GYRO_BIAS] + C.inv().apply([0, 0, 9.80665])]
    )
    imu = Imu(np.full(samples, -(10**9), dtype=np.int64), np.tile(level, (samples, 1)))
    quiet = Sensors(NOISE._replace(bias_correlation_time_s=1e12), still_earth(), UNCONSTRAINED)
    blind_s = advance(nav, np.eye(ERR), np.zeros(MEMORY), 0, 2 * 10**9, imu, quiet)
    assert blind_s == pytest.approx(2.0, rel=1e-12)
    np.testing.assert_allclose(
        nav[NAV_POSITION], before[NAV_POSITION] + 2.0 * before[NAV_VELOCITY], atol=1e-6
    )
    np.testing.assert_allclose(nav[3:], before[3:], atol=1e-6)


@pytest.mark.parametrize(("stamps_ms", "blind"), [(range(10, 101, 10), False), ((10,), True)])
def test_a_chunk_without_samples_is_trusted_less(stamps_ms: range, blind: bool) -> None:
    """The noise is that of the IMU, or of a hole; the biases wander as they always do."""
    cov = np.diag(np.repeat([1.0, 0.1, 0.01, 1e-3, 1e-5], 3))
    chunk, before = Chunk(np.empty(7), np.empty((ERR, ERR))), cov.copy()
    imu = Imu(np.array(stamps_ms, dtype=np.int64) * MS, np.ones((len(stamps_ms), 6)))
    predict_chunk(resting(), cov, np.zeros(MEMORY), 0, 100 * MS, imu, SENSORS, chunk)
    taken = InertialNoise(*BLIND, *NOISE[2:]) if blind else NOISE
    propagate(before, chunk.transition, 0.1, taken)
    np.testing.assert_allclose(cov, before, rtol=1e-12, atol=1e-18)


def test_nothing_is_held_in_a_hole() -> None:
    """A vehicle that does not slip, as far as there are samples; then nobody knows."""
    held = Constraints(0.1, 0.1, 0.0, 0.0, 0.0)
    sds = []
    for count in (300, 0):
        stamps = np.arange(1, count + 1, dtype=np.int64) * 10 * MS
        nav, cov = moving(10.0), np.diag([1.0] * 6 + [1e-6] * 9)
        imu = Imu(stamps, np.tile([0, 0, 0, 0, 0, 9.80665], (count, 1)))
        driven(nav, cov, imu, 3.0, held)
        sds.append(np.sqrt(cov[Err.VY, Err.VY]))
    assert sds[0] < 0.1
    assert sds[1] > 1.0


def test_every_bias_fades_with_its_own_time() -> None:
    """Three of them over a second, with what they share; the clock goes on by its drift."""
    sds, taus = np.array([2.0, 0.5, 3.0]), np.array([30.0, 5.0, 0.8])
    slow = SlowErrors(0.0, 0.0, np.array([sds, taus]))
    known = np.array([1.5, -0.8, 0.3])
    nav, cov = np.concatenate([resting(), [100.0, 7.0], known]), np.eye(ERR + 5)
    cov[ERR + 2 :, ERR + 2 :] += 0.5
    shared = cov[ERR + 2 :, ERR + 2 :].copy()
    stamps = np.arange(10, 1001, 10, dtype=np.int64) * MS
    imu = Imu(stamps, np.tile([0.0, 0, 0, 0, 0, 9.80665], (stamps.size, 1)))
    sensors = Sensors(NOISE, still_earth(), UNCONSTRAINED, slow)
    assert advance(nav, cov, np.zeros(MEMORY), 0, 1000 * MS, imu, sensors) == 0.0
    fade = np.exp(-1.0 / taus)
    np.testing.assert_allclose(nav[NAV:], [107.0, 7.0, *(fade * known)], rtol=1e-12)
    expected = shared * np.outer(fade, fade) + np.diag(sds**2 * (1.0 - fade**2))
    np.testing.assert_allclose(cov[ERR + 2 :, ERR + 2 :], expected, rtol=1e-9)
