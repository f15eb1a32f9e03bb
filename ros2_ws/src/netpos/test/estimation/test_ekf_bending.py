"""Updates and gates where the model bends over the width of the prior."""

from __future__ import annotations

import math

import numpy as np
import pytest
from curved_rows import bends, log_posterior_cost, range_problem, two_variances
from ekf_update import exact_fuse, fused, iterated, scratch, updated
from filter_rows import NO_GATE, linear_row, row
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import (
    GATE_VARIANCE,
    GROUP,
    SAME_BEND,
    VALUE,
    VARIANCE,
    Kind,
    linearise,
)
from netpos.estimation.state import VELOCITY, X
from netpos.estimation.update import fit, fusion
from netpos.estimation.update.predicted import predict_rows
from netpos.messages.values import Array
from scipy.optimize import brentq
from scipy.stats import chi2


def passes(mean: Array, cov: Array, rows: Array, threshold: float, iterations: int) -> bool:
    """The decision on one group with its gate variances as they are (``gate`` adds the
    curvature)."""
    n, m = mean.size, len(rows)
    work = scratch(n, m)
    predict_rows(mean, cov, rows, 0.0, fusion.predicted_in(work, n, m))
    work[fusion.W_GATE_VARIANCE, :m] = rows[:, GATE_VARIANCE]
    return bool(ekf._passes(mean, cov, rows, (0, m), 0.0, threshold, iterations, work))


def curved_group() -> tuple[Array, Array, Array]:
    """A range across a prior 20 m wide sideways: far by the tangent, near in truth."""
    mean, cov = np.array([30.0, 1e-3, 0, 0, 0, 0]), np.diag([0.01, 400.0, 1, 1, 1, 1.0])
    truth = math.hypot(30.0, 20.0)  # one sd sideways
    return mean, cov, np.array([row(Kind.RANGE, truth, 0.01, 0, np.zeros(3))])


def test_curved_group_passes_by_its_most_probable_state_only_when_iterating() -> None:
    mean, cov, rows = curved_group()
    threshold = chi2.ppf(0.999, 1)
    assert not passes(mean, cov, rows, threshold, 1)
    assert passes(mean, cov, rows, threshold, 20)
    x, _ = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), 20)
    cost = log_posterior_cost(rows, mean, cov, 0.0, x)
    assert passes(mean, cov, rows, cost * 1.0001, 20)
    assert not passes(mean, cov, rows, cost * 0.9999, 20)


def test_gate_threshold_itself_is_inside_and_one_iteration_decides_by_the_tangent() -> None:
    """y 0.5 m, range 31 m with 2 m sd: 8.0 from the mean range, 0.2 at the most probable state."""
    mean, cov, rows = curved_group()
    mean[X.PY], rows[0, VALUE], rows[0, VARIANCE], rows[0, GATE_VARIANCE] = 0.5, 31.0, 4.0, 4.0
    innovation, H = linearise(rows, mean, 0.0)
    innovation -= bends(mean, cov, rows)
    # As the kernel rounds it: the last bit decides here.
    nis = innovation[0] ** 2 / (4.0 + (H @ (H @ cov).T).item())
    assert nis == pytest.approx(ekf.group_nis(cov, innovation, H, np.array([4.0])), rel=1e-14)
    x, _ = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), 1)
    assert fit.map_cost(mean, cov, rows, rows[:, VARIANCE].copy(), 0.0, x) < 0.6 * nis
    for iterations in (0, 1):
        assert passes(mean, cov, rows, nis, iterations)
        assert not passes(mean, cov, rows, np.nextafter(nis, 0), iterations)
    for iterations in (2, 8):
        x, _ = iterated(mean, cov, rows, rows[:, VARIANCE].copy(), iterations)
        cost = fit.map_cost(mean, cov, rows, rows[:, VARIANCE].copy(), 0.0, x)
        assert cost < 0.6 * nis
        assert passes(mean, cov, rows, cost, iterations)
        assert not passes(mean, cov, rows, np.nextafter(cost, 0), iterations)
        assert passes(mean, cov, rows, nis, iterations)


def test_update_adds_the_curvature_to_both_variances() -> None:
    """half of (sideways variance / range)^2: 400^2 / 2 / 30^2; and to the range half of sideways
    variance / range."""
    mean, cov, rows = curved_group()
    before = rows.copy()
    x, P, _, nis, _ = updated(mean, cov, rows, 0.0, NO_GATE, 1)
    np.testing.assert_array_equal(rows, before)  # the caller's rows are left alone
    variance = 0.01 + 400.0**2 / 2 / 30.0**2
    innovation, H = linearise(rows, mean, 0.0)
    innovation -= 400.0 / 2 / 30.0
    expected = fused(mean, cov, innovation, H, np.array([variance]))
    np.testing.assert_allclose(x, expected[0], rtol=1e-7)
    np.testing.assert_allclose(P, expected[1], rtol=1e-7, atol=1e-9)
    S = float((H @ cov @ H.T)[0, 0]) + variance
    assert nis == pytest.approx(innovation[0] ** 2 / S, rel=1e-6)


@pytest.mark.parametrize(
    ("more", "speed", "values"),
    [(0.0, 0.0, 1.0), (3.0, 0.0, 4.0), (36.0, 1.5, 37.0), (36.0, 3.0, 18.5), (36.0, 60.0, 1.0)],
)
def test_what_linearising_leaves_out_of_repeated_values_averages_as_one(
    more: float, speed: float, values: float
) -> None:
    """As if the curvature came in that many ``values``, those of a second or of 1.5 m, a twentieth
    of the distance: in the update, not in the gate."""
    mean, cov, rows = curved_group()
    mean[VELOCITY] = 0.6 * speed, -0.8 * speed
    rows[:, SAME_BEND] = more
    x, P, _, nis, _ = updated(mean, cov, rows, 0.0, NO_GATE, 1)
    curvature = 400.0**2 / 2 / 30.0**2
    innovation, H = linearise(rows, mean, 0.0)
    innovation -= 400.0 / 2 / 30.0
    expected = fused(mean, cov, innovation, H, np.array([0.01 + values * curvature]))
    np.testing.assert_allclose(x, expected[0], rtol=1e-7)
    np.testing.assert_allclose(P, expected[1], rtol=1e-7, atol=1e-9)
    S = float((H @ cov @ H.T)[0, 0]) + 0.01 + curvature
    assert nis == pytest.approx(innovation[0] ** 2 / S, rel=1e-6)


def test_other_values_of_a_bend_have_the_true_curvature_of_a_direction() -> None:
    """An azimuth bends by dx dy / r^2 alone, in the update by its largest curvature once."""
    mean, cov = np.array([10.0, 0.0, 0, 0, 0, 0]), np.diag([4.0, 0.25, 1, 1, 1, 1.0])
    rows = np.array([row(Kind.AZIMUTH, 0.05, 1e-4, 0, np.zeros(3))])
    rows[:, SAME_BEND] = 9.0
    x, P, *_ = updated(mean, cov, rows, 0.0, NO_GATE, 1)
    largest, true = (4.0**2 + 0.25**2) / 2 / 10.0**4, 4.0 * 0.25 / 10.0**4
    gain = 0.25 / 10.0 / (0.25 / 100.0 + 1e-4 + largest + 9.0 * true)
    assert x[X.PY] == pytest.approx(gain * 0.05, rel=1e-9)
    assert P[X.PY, X.PY] == pytest.approx(0.25 - gain * 0.25 / 10.0, rel=1e-9)


def test_height_of_the_device_reaches_every_stage() -> None:
    """An RSU 3 m up: with the right height the range fits, with another it does not."""
    mean, cov = np.array([4.0, 0, 0, 0, 0, 0]), 0.01 * np.eye(6)
    longer = 0.01 * (2.0 - 0.8**2) / 2.0 / 5.0
    rows = np.array([row(Kind.RANGE, 5.0 + longer, 1e-4, 0, np.array([0.0, 0.0, 3.0]))])
    gate = np.array([0.0, 9.0])
    for iterations in (1, 8):
        good = updated(mean, cov, rows, 0.0, gate, iterations)
        assert good[2].tolist() == [1.0]
        assert good[3] == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(good[0], mean, atol=1e-12)
        assert updated(mean, cov, rows, -3.0, gate, iterations)[2].tolist() == [0.0]


def slightly_bent(kind: Kind, share: float, variance: float, side: int) -> tuple[Array, ...]:
    """One row whose value at the state the EKF ends in is ``share`` of an sd off the tangent at
    the prior: a state that moves along and across the line of sight."""
    mean, cov = np.array([10.0, 0, 3.0, 0, 0, 0]), np.eye(6)
    cov[X.PX, X.PY] = cov[X.PY, X.PX] = cov[X.VX, X.VY] = cov[X.VY, X.VX] = 0.9 * side
    rows = np.array([row(kind, 0.0, variance, 0, np.zeros(3))])
    rows[0, GATE_VARIANCE] = variance / 2.0
    rows[0, VALUE] -= linearise(rows, mean, 0.0)[0][0]
    nominal, sd = rows[0, VALUE], math.sqrt(two_variances(mean, cov, rows)[0])

    def away(offset: float) -> float:
        rows[0, VALUE] = nominal + offset
        innovation, H = linearise(rows, mean, 0.0)
        x, *_ = fused(mean, cov, innovation, H, np.array([sd**2]))
        return float(abs(linearise(rows, x, 0.0)[0] - innovation + H @ (x - mean))[0] / sd)

    away(brentq(lambda offset: away(offset) - share, 0.0, 0.3 if kind is Kind.AZIMUTH else 3.0))
    return mean, cov, rows


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    ("kind", "variance"), [(Kind.SPEED, 1.0), (Kind.SPEED, 0.25), (Kind.AZIMUTH, 2.5e-3)]
)
def test_update_iterates_only_where_the_model_bends(
    kind: Kind, variance: float, side: int
) -> None:
    """Just under and just over 2 % of the noise's sd between the row and its tangent, which lies
    above it or below."""
    mean, cov, rows = slightly_bent(kind, 0.02 * (1 - 1e-6), variance, side)
    plain = updated(mean, cov, rows, 0.0, NO_GATE, 1)
    straight = updated(mean, cov, rows, 0.0, NO_GATE, 8)
    np.testing.assert_array_equal(straight[0], plain[0])  # bit for bit
    np.testing.assert_array_equal(straight[1], plain[1])
    mean, cov, rows = slightly_bent(kind, 0.02 * (1 + 1e-6), variance, side)
    plain = updated(mean, cov, rows, 0.0, NO_GATE, 1)
    bent = updated(mean, cov, rows, 0.0, NO_GATE, 8)
    expected = iterated(mean, cov, rows, two_variances(mean, cov, rows), 8)
    np.testing.assert_array_equal(bent[0], expected[0])
    np.testing.assert_array_equal(bent[1], expected[1])
    assert np.abs(bent[0] - plain[0]).max() > 1e-4
    assert bent[3:] == plain[3:]  # nis and number are those of the prior


@pytest.mark.parametrize(("share", "iterates"), [(1.099, False), (1.101, True)])
def test_update_iterates_where_the_prior_is_wide(share: float, iterates: bool) -> None:
    """The curvature adds a tenth to the variance of a bearing that hardly leaves its tangent: it
    would see a narrow strip from a wrong side."""
    extra = 2.5e-3 / (share - 1.0)
    for _ in range(2):  # the curvature does not depend on the variance
        mean, cov, rows = slightly_bent(Kind.AZIMUTH, 0.01, extra, 1)
        extra = float(two_variances(mean, cov, rows)[0] - rows[0, VARIANCE]) / (share - 1.0)
    mean, cov, rows = slightly_bent(Kind.AZIMUTH, 0.01, extra, 1)
    x, P, *_ = updated(mean, cov, rows, 0.0, NO_GATE, 8)
    plain, P_plain, *_ = updated(mean, cov, rows, 0.0, NO_GATE, 1)
    assert np.array_equal(x, plain) is not iterates
    assert np.array_equal(P, P_plain) is not iterates


@pytest.mark.parametrize("iterations", [2, 8])
def test_only_what_was_accepted_is_iterated_with_the_variances_of_the_update(
    iterations: int,
) -> None:
    mean, cov, rows = range_problem(2)
    rows[1, VALUE] += 1e4  # rejected, and in the middle
    rows[:, GATE_VARIANCE] = rows[:, VARIANCE] / 3.0
    result = updated(mean, cov, rows, 0.0, np.array([0.0, 1e3]), iterations)
    kept, variance = rows[::2].copy(), two_variances(mean, cov, rows)[::2].copy()
    innovation, H = linearise(kept, mean, 0.0)
    innovation -= bends(mean, cov, kept)
    x, P, _ = fused(mean, cov, innovation, H, variance)
    at_mean = kept.copy()
    at_mean[:, VALUE] -= bends(x, P, kept)
    expected = iterated(mean, cov, at_mean, variance, iterations)
    np.testing.assert_array_equal(result[0], expected[0])
    np.testing.assert_array_equal(result[1], expected[1])
    assert result[2].tolist() == [1.0, 0.0, 1.0]
    S = H @ cov @ H.T + np.diag(variance - kept[:, VARIANCE] + kept[:, GATE_VARIANCE])
    assert result[3] == pytest.approx(innovation @ np.linalg.inv(S) @ innovation, rel=1e-9)


def test_a_rejected_row_that_bends_is_no_reason_to_iterate() -> None:
    """It bends by 100 times as much of its noise; what is accepted, by just under the limit."""
    mean, cov, rows = slightly_bent(Kind.SPEED, 0.02 * (1 - 1e-6), 1.0, 1)
    far = row(Kind.SPEED, 1e3, 1e-4, 0, np.zeros(3))
    gate, both = np.array([0.0, 9.0]), np.vstack([far, rows])
    both[1, GROUP] = 1
    plain = updated(mean, cov, both, 0.0, gate, 1)
    result = updated(mean, cov, both, 0.0, gate, 8)
    assert result[2].tolist() == [0.0, 1.0]
    np.testing.assert_array_equal(result[0], plain[0])
    np.testing.assert_array_equal(result[1], plain[1])


def nearly_singular(seed: int) -> tuple[Array, Array, Array]:
    """Sds up to 1e6, correlations near 1, three precise rows and a speed that bends."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-1, 6, 6)
    A = rng.normal(size=(6, 2))
    P = (A @ A.T + 1e-8 * np.eye(6)) * np.outer(scale, scale)
    P = (P + P.T) / 2
    H, R, x = rng.normal(size=(3, 6)), 10.0 ** rng.uniform(-6, -2, 3), rng.normal(size=6)
    truth = x + np.linalg.cholesky(P) @ rng.normal(size=6)
    rows = [linear_row(h, h @ truth, r, 0) for h, r in zip(H, R, strict=True)]
    speed = row(Kind.SPEED, math.hypot(truth[X.VX], truth[X.VY]), 0.01)
    return x, P, np.array([*rows, speed])


def test_where_rounding_makes_iterating_indefinite_the_tangent_serves() -> None:
    """Iterated row by row the covariance ends indefinite; what is returned is the linear update,
    exactly. Which seeds do so depends on the processor's rounding."""
    lost = 0
    for seed in range(200):
        x, P, rows = nearly_singular(seed)
        _, cov = iterated(x, P, rows, rows[:, VARIANCE].copy(), 8)
        sd = np.sqrt(np.abs(np.diag(cov)))
        if np.linalg.eigvalsh(cov / np.outer(sd, sd))[0] > -1e-3:
            continue
        lost += 1
        mean, cov, *_ = updated(x, P, rows, 0.0, NO_GATE, 8)
        innovation, H = linearise(rows, x, 0.0)
        expected_mean, expected_cov = exact_fuse(x, P, innovation, H, rows[:, VARIANCE])
        sd = np.sqrt(np.diag(expected_cov))
        np.testing.assert_allclose((mean - expected_mean) / sd, 0.0, atol=0.01)
        np.testing.assert_allclose((cov - expected_cov) / np.outer(sd, sd), 0.0, atol=1e-6)
    assert lost >= 3


@pytest.mark.parametrize("iterations", [1, 8])
def test_ranges_of_an_arc_keep_its_mean(iterations: int) -> None:
    """40 equal ranges of 25 m across a prior 1.6 m wide: the sum over a grid is 4.5 cm nearer
    than the range, three sd of what is known along it."""
    mean, cov = np.array([25.0, 0, 0, 0, 0, 0]), np.diag([0.3**2, 1.6**2, 1, 1, 1, 1.0])
    rows = np.array([row(Kind.RANGE, 25.0, 0.1**2, 0, np.zeros(3))])
    x, y = np.meshgrid(np.linspace(23.5, 26.5, 1501), np.linspace(-8.0, 8.0, 801))
    cost = (x - 25.0) ** 2 / 0.3**2 + y**2 / 1.6**2
    cost += 40 * (np.hypot(x, y) - 25.0) ** 2 / 0.1**2
    weight = np.exp(-0.5 * (cost - cost.min()))
    expected = float((weight * x).sum() / weight.sum())
    assert expected == pytest.approx(24.955, abs=0.001)
    for _ in range(40):
        mean, cov, *_ = updated(mean, cov, rows, 0.0, NO_GATE, iterations)
    assert mean[X.PX] == pytest.approx(expected, abs=0.012)
