"""Gating of the extended Kalman filter: limits, groups, distances."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ekf_update import fused, updated
from filter_rows import NO_GATE, linear_row, random_spd
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import (
    GATE_VARIANCE,
    GROUP,
    ORIGIN,
    VALUE,
    VARIANCE,
)
from netpos.estimation.state import X
from netpos.estimation.update.fusion import predicted_in
from netpos.estimation.update.predicted import predict_rows
from netpos.messages.values import Array
from scipy.stats import chi2


def two_states() -> tuple[Array, Array]:
    return np.zeros(6), np.diag([4.0, 9.0, 1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize("iterations", [1, 8])
@pytest.mark.parametrize(("factor", "accepted"), [(1 - 1e-9, True), (1 + 1e-9, False)])
@pytest.mark.parametrize("dof", [1, 2, 3])
def test_gate_at_its_boundary(dof: int, factor: float, accepted: bool, iterations: int) -> None:
    """A group whose squared distance is just inside or just outside the quantile."""
    mean, cov = two_states()
    gate = np.append(0.0, chi2.ppf(0.99, np.arange(1, 4)))
    value = math.sqrt(gate[dof] * factor * (4.0 + 0.5))  # only the first row is off
    rows = np.array([linear_row(np.eye(6)[i], value * (i == 0), 0.5, 0) for i in range(dof)])
    x, P, taken, nis, used = updated(mean, cov, rows, 0.0, gate, iterations)
    assert bool(taken[0]) is accepted
    assert used == (dof if accepted else 0)
    if accepted:
        assert nis == pytest.approx(gate[dof])
        assert x[X.PX] > 0.0
    else:
        assert nis == 0.0
        np.testing.assert_array_equal(x, mean)
        np.testing.assert_array_equal(P, cov)


def test_gate_has_one_threshold_per_number_of_rows_and_the_last_for_more() -> None:
    mean, cov = np.zeros(6), np.eye(6)
    rows = np.array([linear_row(np.eye(6)[i], 2.0, 1.0, 0) for i in range(4)])  # NIS 2 per row
    for gate, accepted in (([0, 0, 0, 8.1], 1.0), ([0, 0, 0, 7.9], 0.0), ([0, 9, 9, 9, 7.9], 0.0)):
        assert updated(mean, cov, rows, 0.0, np.array(gate, float), 1)[2].tolist() == [accepted]


def test_every_group_has_the_threshold_of_its_own_size() -> None:
    mean, cov = np.zeros(6), np.eye(6)
    sizes = (1, 2, 1)  # NIS 2 per row
    rows = [
        linear_row(np.eye(6)[i], 2.0, 1.0, group)
        for i, group in enumerate(g for g, size in enumerate(sizes) for _ in range(size))
    ]
    for gate, taken in (([0, 2.1, 3.9, 99], [1, 0, 1]), ([0, 1.9, 4.1, 99], [0, 1, 0])):
        result = updated(mean, cov, np.array(rows), 0.0, np.array(gate, float), 1)
        assert result[2].tolist() == taken


def test_gate_looks_at_the_gate_variance_and_the_update_at_the_variance() -> None:
    mean, cov = np.zeros(6), np.eye(6)
    one = linear_row(np.eye(6)[0], 4.0, 99.0, 0)
    one[GATE_VARIANCE] = 3.0
    gate = np.array([0.0, 4.001])
    x, P, taken, nis, _ = updated(mean, cov, one[None], 0.0, gate, 1)
    assert taken.tolist() == [1.0]
    assert nis == pytest.approx(16 / 4)
    assert x[X.PX] == pytest.approx(4.0 / 100)
    assert P[X.PX, X.PX] == pytest.approx(99 / 100)
    gate[1] = 3.999
    assert updated(mean, cov, one[None], 0.0, gate, 8)[2].tolist() == [0.0]


@pytest.mark.parametrize("iterations", [1, 8])
@pytest.mark.parametrize("bad", [0, 1, 2])
def test_a_group_is_rejected_as_a_whole_and_alone(bad: int, iterations: int) -> None:
    """The rejected group's good row must not enter; the other groups' rows must."""
    mean, cov = two_states()
    gate = np.append(0.0, chi2.ppf(0.999, np.arange(1, 4)))
    rows = []
    for group in range(3):
        off = 100.0 if group == bad else 0.1
        rows.append(linear_row(np.eye(6)[2 * group], 0.2, 0.5, group))
        rows.append(linear_row(np.eye(6)[2 * group + 1], off, 0.5, group))
    x, _, taken, nis, used = updated(mean, cov, np.array(rows), 0.0, gate, iterations)
    assert taken.tolist() == [float(g != bad) for g in range(3)]
    kept = np.array([r for r in rows if r[GROUP] != bad])
    assert used == 4
    expected = updated(mean, cov, _renumbered(kept), 0.0, NO_GATE, iterations)
    np.testing.assert_array_equal(x, expected[0])
    assert nis == expected[3]
    np.testing.assert_array_equal(x[2 * bad : 2 * bad + 2], 0.0)


def _renumbered(rows: Array) -> Array:
    rows = rows.copy()
    rows[:, GROUP] = np.unique(rows[:, GROUP], return_inverse=True)[1]
    return rows


def test_groups_may_differ_in_size_and_their_order_does_not_matter() -> None:
    mean, cov = two_states()
    cov[X.PX, X.PY] = cov[X.PY, X.PX] = 2.0
    a = [linear_row(np.eye(6)[0], 1.0, 0.5, 0)]
    b = [linear_row(np.eye(6)[1], v, 0.7, 1) for v in (-0.5, 0.3, 0.4)]
    forward = updated(mean, cov, np.array(a + b), 0.0, NO_GATE, 1)
    swapped = [r.copy() for r in b + a]
    for r in swapped:
        r[GROUP] = 1 - r[GROUP]
    backward = updated(mean, cov, np.array(swapped), 0.0, NO_GATE, 1)
    np.testing.assert_allclose(forward[0], backward[0], rtol=1e-12)
    np.testing.assert_allclose(forward[1], backward[1], rtol=1e-12, atol=1e-15)
    assert forward[3] == pytest.approx(backward[3], rel=1e-12)
    assert forward[2].tolist() == backward[2].tolist() == [1.0, 1.0]


def coloured_rows(rng: np.random.Generator, sizes: tuple[int, ...]) -> Array:
    """Linear rows in groups of the given sizes with random values, variances, gate variances."""
    groups = [g for g, size in enumerate(sizes) for _ in range(size)]
    rows = [linear_row(rng.normal(size=6), rng.normal(), rng.uniform(1, 3), g) for g in groups]
    out = np.array(rows)
    out[:, GATE_VARIANCE] = out[:, VARIANCE] * rng.uniform(0.2, 0.9, len(rows))
    return out


def distance_by_numpy(x: Array, P: Array, rows: Array, column: int) -> float:
    """Squared Mahalanobis distance of linear rows with the variances in ``column``."""
    H = rows[:, ORIGIN : ORIGIN + 6]
    S = H @ P @ H.T + np.diag(rows[:, column])
    nu = rows[:, VALUE] - H @ x
    return float(nu @ np.linalg.inv(S) @ nu)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("iterations", [1, 8])
@pytest.mark.parametrize("coloured", [(), (0,), (1, 2), (0, 1, 2)])
@pytest.mark.parametrize("rejected", [None, 0, 2])
def test_nis_is_that_of_the_gate_variances_of_what_was_accepted(
    rejected: int | None, coloured: tuple[int, ...], iterations: int, seed: int
) -> None:
    """Groups of which some have correlated errors; one of them may lie far off."""
    rng = np.random.default_rng(seed)
    x, P, rows = rng.normal(size=6), random_spd(rng, 6), coloured_rows(rng, (1, 4, 2))
    white = ~np.isin(rows[:, GROUP], coloured)
    rows[white, GATE_VARIANCE] = rows[white, VARIANCE]
    if rejected is not None:
        rows[rows[:, GROUP] == rejected, VALUE] += 1e4
    kept = rows[rows[:, GROUP] != (-1 if rejected is None else rejected)]
    gate = np.full(5, 1e3)
    mean, cov, accepted, nis, used = updated(x, P, rows, 0.0, gate, iterations)
    assert accepted.tolist() == [float(g != rejected) for g in range(3)]
    assert used == len(kept)
    assert nis == pytest.approx(distance_by_numpy(x, P, kept, GATE_VARIANCE), rel=1e-9)
    expected = fused(
        x,
        P,
        kept[:, VALUE] - kept[:, ORIGIN : ORIGIN + 6] @ x,
        kept[:, ORIGIN : ORIGIN + 6].copy(),
        kept[:, VARIANCE].copy(),
    )
    np.testing.assert_allclose(mean, expected[0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(cov, expected[1], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("before", [0, 2])
@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_gate_of_correlated_rows_at_its_boundary(size: int, before: int, seed: int) -> None:
    """All rows of a group off, H and P full: just inside and just outside, wherever it stands."""
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=6), random_spd(rng, 6)
    rows = coloured_rows(rng, (before, size, 1) if before else (size, 1))
    group = 1 if before else 0
    limit = distance_by_numpy(x, P, rows[rows[:, GROUP] == group], GATE_VARIANCE)
    for factor, taken in ((1 + 1e-9, 1.0), (1 - 1e-9, 0.0)):
        gate = np.full(7, limit * factor)
        work, accepted = ekf.workspace(6, len(rows)), np.full(group + 2, 9.0)
        mean, cov = x.copy(), P.copy()
        predict_rows(mean, cov, rows, 0.0, predicted_in(work, 6, len(rows)))
        used = ekf.gate(mean, cov, rows, 0.0, gate, 1, accepted, work)
        assert accepted[group] == taken
        assert used == sum(accepted[int(g)] for g in rows[:, GROUP])
        np.testing.assert_array_equal(mean, x)  # gating changes nothing
        np.testing.assert_array_equal(cov, P)


@pytest.mark.parametrize("iterations", [1, 8])
@pytest.mark.parametrize("limits", [[0.0, math.inf], [0.0, 1.0, 1.0, math.inf]])
def test_an_open_gate_accepts_whatever_comes(limits: list[float], iterations: int) -> None:
    rows = coloured_rows(np.random.default_rng(0), (1, 3, 2))
    rows[:, VALUE] += 1e9
    result = updated(np.zeros(6), np.eye(6), rows, 0.0, np.array(limits), iterations)
    assert result[2].tolist() == [1.0, 1.0, 1.0]
    assert result[4] == 6
    assert result[3] == pytest.approx(
        distance_by_numpy(np.zeros(6), np.eye(6), rows, GATE_VARIANCE), rel=1e-9
    )


@pytest.mark.parametrize("iterations", [1, 8])
def test_nothing_accepted_changes_nothing(iterations: int) -> None:
    """All groups rejected, of every size: mean and cov are the prior's, bit for bit."""
    rng = np.random.default_rng(1)
    x, P, rows = rng.normal(size=6), random_spd(rng, 6), coloured_rows(rng, (1, 2, 3))
    rows[:, VALUE] += 1e4
    mean, cov, accepted, nis, used = updated(x, P, rows, 0.0, np.full(4, 9.0), iterations)
    np.testing.assert_array_equal(mean, x)
    np.testing.assert_array_equal(cov, P)
    assert accepted.tolist() == [0.0, 0.0, 0.0]
    assert (nis, used) == (0.0, 0)
