"""Iron that was put in comes out again; what cannot be told is refused."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.inertial.magnetic_calibration import fit_iron
from scipy.spatial.transform import Rotation

FIELD_T = np.array([3e-6, 15e-6, -49e-6])
HARD_T = np.array([12e-6, -20e-6, 7e-6])
SOFT = np.array([[1.06, 0.03, -0.02], [0.03, 0.95, 0.01], [-0.02, 0.01, 1.01]])


def readings(turns: Rotation, noise_sd_t: float = 0.0, seed: int = 0) -> np.ndarray:
    body = turns.inv().apply(FIELD_T)
    noise = np.random.default_rng(seed).normal(scale=noise_sd_t, size=body.shape)
    return body @ SOFT.T + HARD_T + noise


def test_perfect_readings_give_back_the_iron() -> None:
    turns = Rotation.random(60, rng=np.random.default_rng(1))
    fit = fit_iron(readings(turns))
    np.testing.assert_allclose(fit.offset, HARD_T, atol=1e-14)
    scale = np.linalg.det(SOFT) ** (1 / 3)
    np.testing.assert_allclose(fit.matrix @ SOFT, scale * np.eye(3), atol=1e-9)
    assert fit.residual_sd < 1e-9
    np.testing.assert_allclose(
        turns.apply(fit.apply(readings(turns))), np.tile(scale * FIELD_T, (60, 1)), atol=1e-13
    )


def test_noisy_readings_are_near_the_truth() -> None:
    """0.3 microtesla of noise over 500 readings: the heading error falls below half a degree."""
    turns = Rotation.random(500, rng=np.random.default_rng(2))
    fit = fit_iron(readings(turns, 0.3e-6))
    np.testing.assert_allclose(fit.offset, HARD_T, atol=0.15e-6)
    level = Rotation.from_rotvec(np.outer(np.linspace(0, 6.28, 50), [0, 0, 1]))
    for calibrated, worst_deg in ((True, 0.5), (False, 20.0)):
        raw = readings(level)
        north = level.apply(fit.apply(raw) if calibrated else raw)
        error = np.degrees(
            np.arctan2(north[:, 1], north[:, 0]) - np.arctan2(FIELD_T[1], FIELD_T[0])
        )
        error = np.abs((error + 180) % 360 - 180)
        assert bool(error.max() < worst_deg) is calibrated
    assert fit.residual_sd == pytest.approx(0.3e-6 / np.linalg.norm(FIELD_T), rel=0.15)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        (np.zeros((19, 3)), "at least 20 finite readings"),
        (np.full((30, 3), np.nan), "at least 20 finite readings"),
        (np.zeros((30, 2)), "at least 20 finite readings"),
        (np.ones((30, 3)), "all readings are the same"),
        (
            readings(Rotation.from_rotvec(np.outer(np.linspace(0, 6.28, 200), [0, 0, 1])), 0.1e-6),
            "not about the vertical alone",
        ),
    ],
)
def test_readings_that_do_not_determine_the_iron_are_refused(
    field: np.ndarray, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        fit_iron(field)
