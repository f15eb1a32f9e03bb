"""Rows re-weighted by how badly they fit, late ranges by how likely their path was blocked."""

from __future__ import annotations

import math
from functools import partial

import filter_rows
import numpy as np
import pytest
from filter_rows import NO_GATE, random_spd
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import (
    AXES,
    BLOCKED,
    GATE_VARIANCE,
    GROUP,
    HEADING,
    KIND,
    ORIGIN,
    VALUE,
    VARIANCE,
    Kind,
    curvature_variance,
)
from netpos.estimation.state import POSITION, X
from netpos.estimation.update import robust
from netpos.estimation.update.conditioning import Robust, RobustOptions, reweight
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import Array
from scipy.integrate import quad

OTHERS = [k for k in Kind if k not in {Kind.TOA, Kind.RANGE}]


def row(kind: Kind, value: float, variance: float, group: int, origin: Array) -> Array:
    """A row whose gate takes half of its variance for noise."""
    return filter_rows.row(kind, value, variance, group, origin, gate_variance=variance / 2.0)


def conditioned(
    mean: Array,
    cov: Array,
    rows: Array,
    weights: tuple[Robust, float] = (Robust.NONE, 0.0),
    late: tuple[float, float] = (0.0, 0.0),
    height_m: float = 0.0,
) -> Array:
    """``reweight`` on a copy of the rows; mean and cov are left alone."""
    out, before = rows.copy(), (mean.copy(), cov.copy())
    # one signature to compile
    options = RobustOptions(int(weights[0]), float(weights[1]), float(late[0]), float(late[1]))
    reweight(cov, out, predicted_rows(mean, cov, out, height_m), options)
    np.testing.assert_array_equal(mean, before[0])
    np.testing.assert_array_equal(cov, before[1])
    return out


def updated(mean: Array, cov: Array, rows: Array) -> tuple[Array, Array]:
    """Ordinary update without a gate."""
    x, P, groups = mean.copy(), cov.copy(), int(rows[:, GROUP].max()) + 1
    work = ekf.workspace(mean.size, len(rows))
    ekf.update(x, P, rows, 0.0, NO_GATE, 1, np.zeros(groups), work)
    return x, P


def mixed_groups(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Groups of 1, 2 and 4 linear rows, and one of a bearing across +-pi with a range; scattered
    far more than they say."""
    mean, cov = np.array([-50.0, 1e-3, 1, 2, 3, 4]), random_spd(rng, 6)
    rows = []
    for group, size in enumerate((1, 2, 4)):
        for _ in range(size):
            one = row(Kind.LINEAR, rng.normal() * 200, rng.uniform(0.5, 2), group, np.zeros(3))
            one[ORIGIN:HEADING], one[ORIGIN : ORIGIN + 6] = 0.0, rng.normal(size=6)
            rows.append(one)
    rows.append(row(Kind.AZIMUTH, -math.pi + 0.4, 1e-3, 3, np.zeros(3)))
    rows.append(row(Kind.RANGE, 70.0, 1.0, 3, np.array([0.0, 0.0, 4.0])))
    return mean, cov, np.array(rows)


def longer_m(mean: Array, cov: Array, origin: Array) -> float:
    """How much longer than the distance of the mean the mean distance is, to second order."""
    d = np.append(mean[POSITION], 0.0) - origin
    r = float(np.linalg.norm(d))
    along = d[:2] @ cov[POSITION, POSITION] @ d[:2] / r**2
    return float(cov[X.PX, X.PX] + cov[X.PY, X.PY] - along) / (2.0 * r)


def innovations(mean: Array, cov: Array, rows: Array) -> tuple[Array, Array]:
    """Of ``mixed_groups``, written out (device on the ground)."""
    nu, H = np.empty(len(rows)), np.zeros((len(rows), 6))
    for i, r in enumerate(rows):
        dx, dy, dz = mean[X.PX] - r[ORIGIN], mean[X.PY] - r[ORIGIN + 1], -r[ORIGIN + 2]
        if r[KIND] == Kind.LINEAR:
            H[i] = r[ORIGIN : ORIGIN + 6]
            nu[i] = r[VALUE] - H[i] @ mean
        elif r[KIND] == Kind.AZIMUTH:
            H[i, :2] = np.array([-dy, dx]) / (dx**2 + dy**2)
            nu[i] = math.remainder(r[VALUE] - math.atan2(dy, dx), 2 * math.pi)
        else:
            H[i, :2] = np.array([dx, dy]) / math.hypot(dx, dy, dz)
            nu[i] = r[VALUE] - math.hypot(dx, dy, dz) - longer_m(mean, cov, r[ORIGIN:AXES])
    return nu, H


def distances2(mean: Array, cov: Array, rows: Array) -> Array:
    """Squared distance of each group with its gate variances."""
    nu, H = innovations(mean, cov, rows)
    out = []
    for group in np.unique(rows[:, GROUP]):
        i = rows[:, GROUP] == group
        curvature = [curvature_variance(one, mean, cov, 0.0) for one in rows[i]]
        S = H[i] @ cov @ H[i].T + np.diag(rows[i, GATE_VARIANCE] + curvature)
        out.append(nu[i] @ np.linalg.inv(S) @ nu[i])
    return np.array(out)


def expected_factors(weights: tuple[Robust, float], d2: Array, sizes: Array) -> Array:
    kind, parameter = weights
    if kind is Robust.HUBER:
        return np.maximum(1.0, np.sqrt(d2 / sizes) / parameter)
    return np.asarray((parameter + d2) / (parameter + sizes))


WEIGHTS = [(Robust.HUBER, 1.345), (Robust.HUBER, 3.0), (Robust.STUDENT_T, 4.0)]


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("seed", range(5))
def test_each_group_has_one_weight(seed: int, weights: tuple[Robust, float]) -> None:
    """Both variances of its rows by one factor, that of its own distance; nothing else changes."""
    mean, cov, rows = mixed_groups(np.random.default_rng(seed))
    sizes = np.array([1, 2, 4, 2])
    factors = expected_factors(weights, distances2(mean, cov, rows), sizes)
    assert factors.max() > 2.0
    out = conditioned(mean, cov, rows, weights)
    for column in (VARIANCE, GATE_VARIANCE):
        np.testing.assert_allclose(
            out[:, column], rows[:, column] * np.repeat(factors, sizes), rtol=1e-9
        )
    out[:, [VARIANCE, GATE_VARIANCE]] = rows[:, [VARIANCE, GATE_VARIANCE]]
    np.testing.assert_array_equal(out, rows)


@pytest.mark.parametrize("sign", [1, -1])
def test_huber_keeps_what_fits_and_student_t_trusts_it_more(sign: int) -> None:
    """Value of one row at its k-th sd, just inside and just outside."""
    mean, cov, k = np.zeros(6), np.eye(6), 1.5
    one = row(Kind.LINEAR, 0.0, 2.0, 0, np.array([1.0, 0.0, 0.0]))
    one[AXES:HEADING], sd = 0.0, math.sqrt(1.0 + 1.0)  # prior, gate variance
    for share, factor in ((1 - 1e-9, 1.0), (1 + 1e-6, 1 + 1e-6), (2.0, 2.0)):
        one[VALUE] = sign * share * k * sd
        out = conditioned(mean, cov, one[None], (Robust.HUBER, k))
        assert out[0, VARIANCE] == pytest.approx(2.0 * factor, rel=1e-9)
    one[VALUE] = 0.0
    out = conditioned(mean, cov, one[None], (Robust.STUDENT_T, 4.0))
    assert out[0, VARIANCE] == pytest.approx(2.0 * 4 / 5, rel=1e-12)


@pytest.mark.parametrize("kind", [Robust.HUBER, Robust.STUDENT_T])
def test_a_weight_beyond_all_numbers_is_not_given(kind: Robust) -> None:
    mean, cov, rows = mixed_groups(np.random.default_rng(1))
    rows[0, VALUE] = 1e200
    out = conditioned(mean, cov, rows, (kind, 2.0))
    np.testing.assert_array_equal(out[0], rows[0])
    assert np.isfinite(out).all()
    assert (out[3:7, VARIANCE] != rows[3:7, VARIANCE]).all()  # the others have theirs


def test_nothing_asked_nothing_changed() -> None:
    mean, cov, rows = mixed_groups(np.random.default_rng(2))
    np.testing.assert_array_equal(conditioned(mean, cov, rows, late=(0.0, 30.0)), rows)


def range_row(kind: Kind, excess_m: float, variance: float = 0.25) -> tuple[Array, Array, Array]:
    """A range from 1 km away, ``excess_m`` longer than predicted."""
    mean = np.array([600.0, 800.0, 1.0, 0.0, 40.0, 0.0])
    cov = random_spd(np.random.default_rng(7), 6)
    value = (
        1000.0 + longer_m(mean, cov, np.zeros(3)) + excess_m + (40.0 if kind is Kind.TOA else 0.0)
    )
    return mean, cov, np.array([row(kind, value, variance, 0, np.zeros(3))])


def moments(kind: Kind, excess_m: float, prior: float, scale_m: float) -> tuple[Array, Array]:
    """Posterior mean and covariance of the mixture by integrating over the excess path."""
    mean, cov, rows = range_row(kind, excess_m)
    h = np.array([0.6, 0.8, 0, 0, 1.0 if kind is Kind.TOA else 0.0, 0])
    S = h @ cov @ h + rows[0, VARIANCE]
    K = cov @ h / S

    def weight(power: int, e: float) -> float:
        density = math.exp(-e / scale_m - (excess_m - e) ** 2 / (2 * S)) / scale_m
        return prior * e**power * density

    peak = max(excess_m - S / scale_m, 0.0)
    blocked = [
        quad(partial(weight, p), 0.0, peak + 60.0, points=[peak], epsabs=0, epsrel=1e-11)[0]
        for p in range(3)
    ]
    total = blocked[0] + (1.0 - prior) * math.exp(-(excess_m**2) / (2 * S))
    E = blocked[1] / total
    V = blocked[2] / total - E**2
    return mean + K * (excess_m - E), cov - np.outer(K, K) * (S - V)


@pytest.mark.parametrize("kind", [Kind.TOA, Kind.RANGE])
@pytest.mark.parametrize(
    ("excess_m", "prior", "scale_m"),
    [
        (-3, 0.2, 5),
        (0, 0.2, 5),
        (1, 0.2, 5),
        (2, 0.2, 5),
        (3, 0.5, 1.5),
        (8, 0.9, 1),
        (8, 0.5, 0.5),
    ],
)
def test_late_range_gives_the_posterior_of_the_mixture(
    excess_m: float, prior: float, scale_m: float, kind: Kind
) -> None:
    """An ordinary update with the row made fit has the moments of both explanations together."""
    mean, cov, rows = range_row(kind, excess_m)
    x, P = updated(mean, cov, conditioned(mean, cov, rows, late=(prior, scale_m)))
    expected_x, expected_P = moments(kind, excess_m, prior, scale_m)
    np.testing.assert_allclose(x - mean, expected_x - mean, atol=5e-6)
    np.testing.assert_allclose(P, expected_P, atol=5e-6)


@pytest.mark.parametrize("kind", [Kind.TOA, Kind.RANGE])
def test_on_time_is_left_almost_alone_and_late_is_pulled(kind: Kind) -> None:
    """1 in 10 blocked, then 30 m longer on average; sd of the prediction 2 and 4 m."""
    late = (0.1, 30.0)
    mean, cov, rows = range_row(kind, 0.3, variance=0.01)
    out = conditioned(mean, cov, rows, late=late)
    assert abs(out[0, VALUE] - rows[0, VALUE]) < 0.05
    plain, made = updated(mean, cov, rows)[0], updated(mean, cov, out)[0]
    np.testing.assert_array_less(np.abs(made - plain), 0.02 * np.sqrt(np.diag(cov)))
    early = range_row(kind, -8.0)[2]  # too early to be blocked
    np.testing.assert_allclose(conditioned(mean, cov, early, late=late), early, atol=0.02)
    mean, cov, rows = range_row(kind, 30.0, variance=0.01)
    out = conditioned(mean, cov, rows, late=late)
    plain, made = updated(mean, cov, rows)[0], updated(mean, cov, out)[0]
    assert np.abs(plain - mean).max() > 5.0
    assert np.abs(made - mean).max() < 0.05 * np.abs(plain - mean).max()


@pytest.mark.parametrize("kind", [Kind.TOA, Kind.RANGE])
@pytest.mark.parametrize("height_m", [0.0, 3.0])
def test_late_range_near_an_rsu_counts_its_curvature(kind: Kind, height_m: float) -> None:
    """5 m ahead of the RSU and as high, 4 m^2 sideways: (4 / 5)^2 / 2 of variance, which the
    update adds again to what the row is left with, and a mean that is 4 / 5 / 2 longer."""
    mean, cov = np.array([5.0, 0, 0, 0, 2.0, 0]), np.diag([1.0, 4.0, 1, 1, 9.0, 1])
    value = 6.5 + (2.0 if kind is Kind.TOA else 0.0)
    rows = np.array([row(kind, value, 0.5, 0, np.array([0.0, 0.0, height_m]))])
    out = conditioned(mean, cov, rows, late=(0.3, 4.0), height_m=height_m)
    R = 0.5 + (4.0 / 5.0) ** 2 / 2
    S = R + 1.0 + (9.0 if kind is Kind.TOA else 0.0)
    _, shift, equivalent = robust.nlos_mixture_exponential(1.5 - 0.4, S, R, 0.3, 4.0)
    assert out[0, VALUE] == pytest.approx(value - shift, rel=1e-12)
    assert out[0, VARIANCE] == pytest.approx(0.5 + equivalent - R, rel=1e-12)
    assert out[0, GATE_VARIANCE] == pytest.approx(0.25 + equivalent - R, rel=1e-12)


def test_two_rival_explanations_say_nothing() -> None:
    """Blocked or not, equally likely and far apart: a row of 1e12 m^2, where it was predicted."""
    mean, cov, rows = range_row(Kind.RANGE, 12.0)
    rows[0, ORIGIN:AXES] = 0.0
    h = np.array([0.6, 0.8, 0, 0, 0, 0])
    S = float(h @ cov @ h) + 0.25
    prior = 1.0 / (1.0 + math.exp(12.0**2 / (2 * S)) * math.sqrt(2 * math.pi * S) / 30.0 * 0.7)
    shift, variance = robust.nlos_mixture_exponential(12.0, S, 0.25, prior, 30.0)[1:]
    assert (shift, variance) == (12.0, math.inf)
    (out,) = conditioned(mean, cov, rows, late=(prior, 30.0))
    assert out[VALUE] == pytest.approx(1000.0 + longer_m(mean, cov, np.zeros(3)), rel=1e-12)
    assert out[VARIANCE] == pytest.approx(1e12)
    assert out[GATE_VARIANCE] == pytest.approx(1e12)
    x, P = updated(mean, cov, out[None])
    np.testing.assert_allclose(x, mean, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(P, cov, rtol=1e-9)


@pytest.mark.parametrize("kind", OTHERS)
def test_only_ranges_and_times_come_late(kind: Kind) -> None:
    mean, cov, rows = range_row(Kind.RANGE, 20.0)
    rows = np.vstack([rows, rows])
    rows[1, [KIND, GROUP]] = kind, 1
    out = conditioned(mean, cov, rows, late=(0.2, 5.0))
    np.testing.assert_array_equal(out[1], rows[1])
    assert out[0, VALUE] < 1010.0
    np.testing.assert_array_equal(
        np.flatnonzero(out[0] != rows[0]), [VALUE, VARIANCE, GATE_VARIANCE, BLOCKED]
    )


@pytest.mark.parametrize("excess", [-1.0, 0.5, 20.0])
def test_a_row_says_how_likely_its_path_was_blocked(excess: float) -> None:
    """It becomes the posterior, and is the prior in place of the option's where it is given."""
    mean, cov, rows = range_row(Kind.RANGE, excess)
    out = conditioned(mean, cov, rows, late=(0.2, 5.0))
    assert 0.0 < out[0, BLOCKED] <= 1.0
    assert (out[0, BLOCKED] > 0.2) == (excess > 3.0)
    given = rows.copy()
    given[0, BLOCKED] = 0.2
    np.testing.assert_array_equal(conditioned(mean, cov, given, late=(0.7, 5.0)), out)


def test_weights_are_given_to_what_is_left_of_a_late_range() -> None:
    """First the shift, then the weight of the shifted row: the late range is no outlier."""
    mean, cov, rows = range_row(Kind.RANGE, 20.0)
    late, weights = (0.2, 5.0), (Robust.STUDENT_T, 4.0)
    both = conditioned(mean, cov, rows, weights, late)
    expected = conditioned(mean, cov, conditioned(mean, cov, rows, late=late), weights)
    np.testing.assert_array_equal(both, expected)
    shifted = conditioned(mean, cov, rows, late=late)
    d2 = distances2(mean, cov, shifted)
    np.testing.assert_allclose(
        both[0, VARIANCE], shifted[0, VARIANCE] * (4 + d2[0]) / 5, rtol=1e-9
    )
    assert d2[0] < 9.0 < distances2(mean, cov, rows)[0]
