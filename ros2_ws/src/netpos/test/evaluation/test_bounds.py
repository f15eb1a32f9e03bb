"""The posterior Cramér-Rao bound against closed forms and against the information recursion."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation.measurement import KIND, ROW_WIDTH, VARIANCE, Kind
from netpos.estimation.motion import NO_BIAS, ProcessNoise, motion_parameters
from netpos.estimation.rows import linear_rows, rsu_axes, rsu_rows, speed_row
from netpos.estimation.state import POSITION, VELOCITY, X
from netpos.evaluation.bounds import bound_covariances, bound_rmse, run_bound
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from scipy.linalg import solve_discrete_are

C = 299_792_458.0
T_S = 0.1
ACCEL = 0.8  # sd per step [m/s^2]
WALK = 2.0  # clock drift sd per step [m/s]
MOTION = motion_parameters(noise=ProcessNoise.WHITE_ACCELERATION, accel=ACCEL, drift_step=WALK)[
    None
]
PRIOR = np.diag([25.0, 16.0, 9.0, 4.0, 1e4, 100.0])


def _model() -> tuple[np.ndarray, np.ndarray]:
    """F and Q of fokin2020:eq.35, 36, written out."""
    F = np.eye(6)
    F[X.PX, X.VX] = F[X.PY, X.VY] = F[X.CLOCK, X.DRIFT] = T_S
    G = np.zeros((6, 2))
    G[0, 0] = G[1, 1] = T_S**2 / 2
    G[2, 0] = G[3, 1] = T_S
    Q = ACCEL**2 * G @ G.T
    Q[5, 5] = WALK**2
    return F, Q


def _stamps(count: int) -> np.ndarray:
    return 1_000_000_000 + np.arange(count) * round(T_S * 1e9)


def test_linear_steady_state_is_the_riccati_solution() -> None:
    """Position and clock measured in every epoch: the bound settles where SciPy's DARE says."""
    F, Q = _model()
    H = np.zeros((3, 6))
    H[0, 0] = H[1, 1] = H[2, 4] = 1.0
    R = np.diag([4.0, 9.0, 25.0])
    epochs = 400
    block = linear_rows(np.zeros(3), R, H, 0)
    bounds = bound_covariances(
        _stamps(epochs),
        3 * np.arange(epochs + 1),
        np.tile(block, (epochs, 1)),
        np.zeros((epochs, 6)),
        PRIOR,
        0.0,
        MOTION,
        NO_BIAS,
    )
    prior = solve_discrete_are(F.T, H.T, Q, R)
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + R)
    np.testing.assert_allclose(bounds[-1], (np.eye(6) - gain @ H) @ prior, rtol=1e-9, atol=1e-12)


def _passage(epochs: int) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """True states of a straight drive past two RSUs, and the rows of every epoch; every third
    epoch has one RSU only, every tenth none."""
    rng = np.random.default_rng(5)
    time = T_S * np.arange(epochs)
    truth = np.column_stack(
        [
            -20 + 8 * time,
            -6 + 0.5 * time,
            *np.tile([[8.0], [0.5]], epochs),
            40 + time,
            1 + 0 * time,
        ]
    )
    blocks = []
    for i in range(epochs):
        rows = [np.zeros((0, ROW_WIDTH))]
        for group, east in enumerate((0.0, 30.0)):
            if i % 10 == 7 or (group == 1 and i % 3 == 0):
                continue
            info = RsuInfo(rsu_id=str(group), position=np.array([east, 2.0, 4.0]))
            m = RsuMeasurement(
                stamp_ns=1,
                rsu_id=info.rsu_id,
                vue_id="vue_1",
                fields=Field.AZIMUTH | Field.TOA,
                azimuth_rad=rng.uniform(-3, 3),
                azimuth_var=np.radians(2.0) ** 2,
                toa_s=1e-6,
                toa_var=(50e-9) ** 2,
            )
            rows.append(rsu_rows(m, info, rsu_axes(info), len(rows) - 1))
        if i % 4 == 0:
            rows.append(speed_row(3.0, 0.25, len(rows) - 1))
        blocks.append(np.vstack(rows))
    return truth, blocks, np.cumsum([0, *(len(b) for b in blocks)])


def _information_recursion(
    truth: np.ndarray, blocks: list[np.ndarray], height: float
) -> list[np.ndarray]:
    """Tichavsky's recursion with the gradients written out anew."""
    F, Q = _model()
    J = np.linalg.inv(PRIOR)
    out = []
    for i, (x, rows) in enumerate(zip(truth, blocks, strict=True)):
        if i:
            J = np.linalg.inv(Q + F @ np.linalg.inv(J) @ F.T)
        for row in rows:
            dx, dy, dz = x[X.PX] - row[7], x[X.PY] - row[8], height - row[9]
            h = np.zeros(6)
            if row[KIND] == Kind.SPEED:
                h[VELOCITY] = x[VELOCITY] / np.hypot(*x[VELOCITY])
            elif row[KIND] == Kind.AZIMUTH:
                h[POSITION] = np.array([-dy, dx]) / (dx * dx + dy * dy)
            else:
                h[POSITION] = np.array([dx, dy]) / np.sqrt(dx * dx + dy * dy + dz * dz)
                h[X.CLOCK] = 1.0
            J = J + np.outer(h, h) / row[VARIANCE]
        out.append(np.linalg.inv(J))
    return out


def test_bound_follows_the_information_recursion() -> None:
    truth, blocks, start = _passage(60)
    bounds = bound_covariances(
        _stamps(60), start, np.vstack(blocks), truth, PRIOR, 1.5, MOTION, NO_BIAS
    )
    for ours, expected in zip(bounds, _information_recursion(truth, blocks, 1.5), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-8, atol=1e-9)


def test_run_bound_interpolates_the_truth() -> None:
    """A straight drive recorded every second, between the epochs: the same bound."""
    truth, blocks, start = _passage(31)
    stamps, rows = _stamps(31), np.vstack(blocks)
    truth_ns = stamps[0] - 250_000_000 + 1_000_000_000 * np.arange(5)
    elapsed = (truth_ns - stamps[0]) / 1e9
    known = truth[0, :4] + elapsed[:, None] * np.array([8.0, 0.5, 0.0, 0.0])
    ours = run_bound(stamps, start, rows, truth_ns, known, PRIOR, MOTION)
    exact = bound_covariances(stamps, start, rows, truth, PRIOR, 0.0, MOTION, NO_BIAS)
    np.testing.assert_allclose(ours, exact, rtol=1e-9)


def test_bound_rmse_is_the_root_of_the_mean_trace() -> None:
    bounds = np.array([np.diag([1.0, 3.0, 99.0]), np.diag([5.0, 7.0, 99.0])])
    assert bound_rmse(bounds) == pytest.approx(np.sqrt((4 + 12) / 2))


def test_what_does_not_fit_is_refused() -> None:
    truth, blocks, start = _passage(5)
    stamps, rows = _stamps(5), np.vstack(blocks)
    whole = {"stamps_ns": stamps, "row_start": start, "rows": rows, "truth_ns": stamps}
    whole |= {"truth_states": truth, "prior_cov": PRIOR, "motions": MOTION}
    zero = rows.copy()
    zero[3, VARIANCE] = 0.0
    for change, words in (
        ({"row_start": start[:-1]}, "one entry more"),
        ({"row_start": start - 1}, "end at the number of rows"),
        ({"stamps_ns": stamps[::-1]}, "must not decrease"),
        ({"rows": zero}, "variance > 0"),
        ({"truth_ns": stamps[:4], "truth_states": truth[:4]}, "beyond the truth"),
    ):
        with pytest.raises(ValueError, match=words):
            run_bound(**{**whole, **change})
