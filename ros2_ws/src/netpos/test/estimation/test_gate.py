"""Groups that pass the gate one by one but contradict each other: every filter leaves a minority
out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import filterpy_reference
import numpy as np
import pytest
from netpos.estimation.forms import ekf, kf, srukf, ukf
from netpos.estimation.measurement import GROUP, Kind
from netpos.estimation.state import X
from netpos.estimation.update import gate
from netpos.messages.values import Array
from scipy.stats import chi2

Maker = Callable[..., Array]
Filter = Callable[[Array, Array, Array, Array, Array], tuple[float, int]]
LIMITS = np.append(0.0, chi2.ppf(0.9999, np.arange(1, 13)))


def by_ekf(mean: Array, cov: Array, rows: Array, limits: Array, ok: Array) -> tuple[float, int]:
    work = ekf.workspace(mean.size, len(rows))
    return ekf.update(mean, cov, rows, 0.0, limits, 1, ok, work)


def by_ukf(mean: Array, cov: Array, rows: Array, limits: Array, ok: Array) -> tuple[float, int]:
    return ukf.update(mean, cov, rows, 0.0, limits, ok)


def by_srukf(mean: Array, cov: Array, rows: Array, limits: Array, ok: Array) -> tuple[float, int]:
    L = np.linalg.cholesky(cov)
    result = srukf.update(mean, L, rows, 0.0, limits, ok)
    cov[:] = L @ L.T
    return result


def by_kf(mean: Array, cov: Array, rows: Array, limits: Array, ok: Array) -> tuple[float, int]:
    return kf.update(mean, cov, rows, 0.0, limits, ok, kf.NO_FLOOR, kf.NOTHING)


def by_filterpy(
    mean: Array, cov: Array, rows: Array, limits: Array, ok: Array
) -> tuple[float, int]:
    return filterpy_reference.ekf_update(mean, cov, rows, 0.0, limits, ok)


FILTERS: dict[str, Filter] = {
    "ekf": by_ekf,
    "ukf": by_ukf,
    "srukf": by_srukf,
    "kf": by_kf,
    "filterpy": by_filterpy,
}


def sharing_an_offset(row: Maker, values: list[float]) -> tuple[Array, Array, Array]:
    """One row a group, all with an unknown offset in them, as times of arrival have."""
    cov = np.diag([1.0, 1.0, 1.0, 1.0, 1e8, 1.0])
    h = (0, 0, 0, 0, 1, 0)
    rows = [row(Kind.LINEAR, 500.0 + v, 1.0, g, h=h) for g, v in enumerate(values)]
    return np.zeros(6), cov, np.array(rows)


@pytest.mark.parametrize("name", FILTERS)
def test_the_one_that_contradicts_the_others_is_left_out(name: str, row: Maker) -> None:
    mean, cov, rows = sharing_an_offset(row, [0.0, 30.0, 0.2, 0.3])
    for g in range(4):
        alone = rows[[g]]
        alone[:, GROUP] = 0
        assert FILTERS[name](mean.copy(), cov.copy(), alone, LIMITS, np.full(1, 9.0))[1] == 1
    x, P, accepted = mean.copy(), cov.copy(), np.full(4, 9.0)
    nis, used = FILTERS[name](x, P, rows, LIMITS, accepted)
    assert accepted.tolist() == [1.0, 0.0, 1.0, 1.0]
    assert used == 3
    precision = 1e-8 + 3.0
    assert x[X.CLOCK] == pytest.approx(1500.5 / precision, rel=1e-8)
    assert P[X.CLOCK, X.CLOCK] == pytest.approx(1.0 / precision, rel=1e-6)
    spread = np.array([500.0, 500.2, 500.3])
    S = 1e8 + np.eye(3)
    assert nis == pytest.approx(spread @ np.linalg.solve(S, spread), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize(
    ("values", "wrong"),
    [
        ([0.0, 30.0, 0.2, 40.0, 0.3], [1, 3]),
        ([30.0, 30.2, 0.1, 0.2, 0.3], [0, 1]),
        ([0.0, 30.0, 0.2, 29.0, 0.3, -50.0, 0.1], [1, 3, 5]),
    ],
)
def test_so_are_several_as_long_as_more_agree(
    name: str, values: list[float], wrong: list[int], row: Maker
) -> None:
    """Whether they agree with each other or not."""
    mean, cov, rows = sharing_an_offset(row, values)
    accepted = np.full(len(values), 9.0)
    used = FILTERS[name](mean, cov, rows, LIMITS, accepted)[1]
    assert np.flatnonzero(accepted == 0.0).tolist() == wrong
    assert used == len(values) - len(wrong)
    assert mean[X.CLOCK] == pytest.approx(500.15, abs=0.1)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize(
    "values",
    [
        *([0.0, 30.0], [0.0, 30.0, 0.2, 30.1], [0.0, 0.3, 0.1], [0.0, 30.0, 60.0]),
        [0.0, 0.1, 30.0, 60.0, 90.0],
    ],
)
def test_without_a_majority_all_are_used(name: str, values: list[float], row: Maker) -> None:
    """Of two nobody knows which is wrong, of two against two neither; three that agree."""
    mean, cov, rows = sharing_an_offset(row, values)
    accepted = np.full(len(values), 9.0)
    assert FILTERS[name](mean, cov, rows, LIMITS, accepted)[1] == len(values)
    assert (accepted == 1.0).all()


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize(
    ("limits", "taken"), [([0, 2.1, 3.9, 99], [1, 0, 1]), ([0, 1.9, 4.1, 99], [0, 1, 0])]
)
def test_every_group_has_the_limit_of_its_own_size(
    name: str, limits: list[float], taken: list[float], row: Maker
) -> None:
    """Groups of one, two and one rows, each row with a squared distance of 2."""
    rows = [row(Kind.LINEAR, 2.0, 1.0, g, h=np.eye(6)[i]) for i, g in enumerate((0, 1, 1, 2))]
    accepted = np.full(3, 9.0)
    FILTERS[name](np.zeros(6), np.eye(6), np.array(rows), np.array(limits, float), accepted)
    assert accepted.tolist() == taken


@pytest.mark.parametrize("seed", range(20))
def test_the_choice_is_that_of_trying_all(seed: int, row: Maker) -> None:
    """Random groups of one to three rows, some refused already, against every subset's chi-square
    by ``numpy.linalg``; one after the other."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 4, size=int(rng.integers(2, 8)))
    group = np.repeat(np.arange(sizes.size), sizes)
    m = group.size
    rows = np.array([row(Kind.RANGE, 0.0, 1.0, int(g)) for g in group])
    A = rng.normal(size=(m, m))
    S = A @ A.T / m + 0.5 * np.eye(m)
    innovation = rng.normal(size=m)
    for _ in range(2):
        innovation[group == rng.integers(sizes.size)] += rng.choice([0.0, 4.0, 12.0])
    accepted = (rng.random(sizes.size) < 0.9).astype(float)
    limits = np.append(0.0, chi2.ppf(0.9, np.arange(1, m + 1)))

    def distance(groups: Sequence[int]) -> float:
        i = np.flatnonzero(np.isin(group, list(groups)))
        return float(innovation[i] @ np.linalg.solve(S[np.ix_(i, i)], innovation[i]))

    def misfit(groups: Sequence[int]) -> float:
        return distance(groups) - float(limits[sizes[list(groups)].sum()])

    kept = rest = tuple(int(g) for g in np.flatnonzero(accepted))
    most = (len(kept) - 1) // 2
    while misfit(rest) > 0.0 and len(rest) > len(kept) - most:
        rest = min(combinations(rest, len(rest) - 1), key=misfit)
    kept = rest if misfit(rest) <= 0.0 else kept
    index, nis = gate.select_rows(rows, innovation, S, limits, accepted)
    assert np.flatnonzero(accepted).tolist() == list(kept)
    assert index.tolist() == np.flatnonzero(np.isin(group, list(kept))).tolist()
    assert nis == pytest.approx(distance(kept), rel=1e-9)


def test_more_rows_than_the_gate_knows_are_not_judged_together(row: Maker) -> None:
    mean, cov, rows = sharing_an_offset(row, [0.0, 30.0, 0.2, 0.3])
    accepted = np.full(4, 9.0)
    assert by_ukf(mean, cov, rows, LIMITS[:4], accepted)[1] == 4
    assert (accepted == 1.0).all()
