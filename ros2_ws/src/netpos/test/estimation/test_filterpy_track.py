"""Whole tracks on FilterPy's objects equal the compiled ones."""

from __future__ import annotations

import math
from collections.abc import Callable

import filterpy_reference as reference
import numpy as np
import pytest
from netpos.estimation.forms import ekf, sigma, ukf
from netpos.estimation.measurement import Kind
from netpos.estimation.motion import Model, motion_parameters
from netpos.estimation.state import X
from netpos.messages.values import Array
from scipy.stats import chi2

Maker = Callable[..., Array]
OPEN = np.array([np.inf])
GATE = np.array([0.0, *chi2.ppf(0.999, [1, 2])])
BIAS = np.array([[0.5], [100.0]])
MOTION = motion_parameters(Model.CONSTANT_TURN, accel=0.5, offset_density=0.1, turn_rate=0.05)
# West of the origin: azimuths pass +-pi as the device goes round.
RSUS = ((0.0, 0.0, 5.0), (60.0, 10.0, 6.0))
HEIGHT = 1.5


def epochs(row: Maker, seed: int) -> list[Array]:
    """300 epochs of DOA and TOA at two RSUs from a circular ride; one in twenty is a lie, and the
    second RSU's TOA has a bias."""
    rng, out = np.random.default_rng(seed), []
    for step in range(300):
        angle = 0.01 * step * 1.5 + 1.0
        p = np.array([-10.0 + 40.0 * math.cos(angle), 40.0 * math.sin(angle), HEIGHT])
        rows = []
        for group, origin in enumerate(RSUS):
            d = p - origin
            lie = 30.0 if rng.random() < 0.05 else 0.0
            azimuth = math.atan2(d[1], d[0]) + 0.02 * rng.normal()
            azimuth = (azimuth + math.pi) % (2 * math.pi) - math.pi
            toa = math.sqrt(d @ d) + 5.0 + lie + 0.5 * rng.normal()
            bias = 7 if group else -1
            rows += [
                row(Kind.AZIMUTH, azimuth, 4e-4, group, origin=origin),
                row(Kind.TOA, toa, 0.3, group, origin=origin, gate_variance=0.25, bias=bias),
            ]
        out.append(np.array(rows))
    return out


def start() -> tuple[Array, Array]:
    mean = np.array([11.0, 33.0, -5.0, 3.0, 4.0, 0.0, 0.1, 0.0])
    return mean, np.diag([9.0, 9, 1, 1, 9, 0.01, 0.01, 0.25])


def compiled_ekf(
    mean: Array, cov: Array, rows: Array, height: float, gate_nis: Array, accepted: Array
) -> tuple[float, int]:
    work = ekf.workspace(mean.size, len(rows))
    result: tuple[float, int] = ekf.update(mean, cov, rows, height, gate_nis, 1, accepted, work)
    return result


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_whole_track_equals_the_compiled_one(name: str, seed: int, row: Maker) -> None:
    ours, update = (ekf, compiled_ekf) if name == "ekf" else (ukf, ukf.update)
    other_predict = getattr(reference, f"{name}_predict")
    other_update = getattr(reference, f"{name}_update")
    (mean, cov), (other, other_cov), rejected, seam = start(), start(), 0, set()
    for rows in epochs(row, seed):
        ours.predict(mean, cov, 0.1, MOTION, BIAS)
        other_predict(other, other_cov, 0.1, MOTION, BIAS)
        accepted, other_accepted = np.full(2, 9.0), np.full(2, 8.0)
        nis, dof = update(mean, cov, rows, HEIGHT, GATE, accepted)
        other_nis, other_dof = other_update(other, other_cov, rows, HEIGHT, GATE, other_accepted)
        assert accepted.tolist() == other_accepted.tolist()
        assert dof == other_dof
        assert nis == pytest.approx(other_nis, rel=1e-7, abs=1e-9)
        np.testing.assert_allclose(mean, other, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(cov, other_cov, rtol=1e-9, atol=1e-9)
        rejected += int((accepted == 0.0).sum())
        seam.add(bool(rows[0, 1] > 0.0))
    assert 10 < rejected < 60
    assert seam == {True, False}
    assert math.hypot(mean[X.PX] + 10.0, mean[X.PY]) == pytest.approx(40.0, abs=2.0)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
@pytest.mark.parametrize("value", [math.pi - 0.01, -math.pi + 0.01])
def test_seam(name: str, value: float, row: Maker) -> None:
    """Due west, with the prediction on the other side of the jump."""
    rows = np.array([row(Kind.AZIMUTH, value, 1e-3)])
    mean, cov = np.array([-20.0, -math.copysign(0.1, value), 1, 0, 0, 0]), np.eye(6)
    other, other_cov = mean.copy(), cov.copy()
    update = compiled_ekf if name == "ekf" else ukf.update
    nis, _ = update(mean, cov, rows, 0.0, OPEN, np.zeros(1))
    result = getattr(reference, f"{name}_update")(other, other_cov, rows, 0.0, OPEN, np.zeros(1))
    assert result == (pytest.approx(nis, rel=1e-9), 1)
    np.testing.assert_allclose(mean, other, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(cov, other_cov, rtol=1e-9, atol=1e-12)
    assert 0.0 < math.copysign(1.0, value) * mean[X.PY] < 0.25


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_nothing_accepted_nothing_moved(name: str, row: Maker) -> None:
    mean, cov = start()
    rows, accepted = epochs(row, 0)[0], np.full(2, 9.0)
    update = getattr(reference, f"{name}_update")
    assert update(mean, cov, rows, HEIGHT, np.array([0.0]), accepted) == (0.0, 0)
    getattr(reference, f"{name}_predict")(mean, cov, 0.0, MOTION, BIAS)
    assert accepted.tolist() == [0.0, 0.0]
    assert (mean == start()[0]).all()
    assert (cov == start()[1]).all()


@pytest.mark.parametrize("n", [6, 13, 20])
def test_points_are_merwes(n: int, random_cov: Maker) -> None:
    """Spread and weights of FilterPy's points follow from ours, and reach sqrt(3) sd."""
    points = reference._points(n)
    assert points.Wc[1] == pytest.approx(0.5 / sigma.REACH2, rel=1e-12)
    assert points.Wm[0] == pytest.approx(1.0 - n / 3.0, rel=1e-12)
    cov = random_cov(np.random.default_rng(n), n)
    away = points.sigma_points(np.zeros(n), cov)[1 : n + 1].T
    L = np.linalg.cholesky(cov)
    np.testing.assert_allclose(away, math.sqrt(3.0) * L, rtol=1e-9, atol=1e-12)
