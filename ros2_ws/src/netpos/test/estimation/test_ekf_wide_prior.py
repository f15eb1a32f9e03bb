"""Updates under priors so wide that the cautious result is far from the only place left."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from curved_rows import bends, log_posterior_cost, two_variances
from ekf_update import fused, iterated, scratch, updated
from filter_rows import NO_GATE, row
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import (
    GROUP,
    VALUE,
    VARIANCE,
    Kind,
    curvature_variance,
    linearise,
)
from netpos.estimation.state import POSITION, X
from netpos.estimation.update import fusion
from netpos.estimation.update.iteration import is_wide
from netpos.messages.values import Array
from scipy.optimize import brentq, least_squares

ALONE, AROUND = (0.0,), (-1.5, 0.0, 1.5)  # starts in sd on each axis


def ranges(place: tuple[float, float], rsus: list[tuple[float, float]], sd_m: float) -> Array:
    """Exact ranges from RSUs to a place, a group each."""
    return np.array(
        [
            row(Kind.RANGE, math.dist(place, rsu), sd_m**2, group, (*rsu, 0.0))
            for group, rsu in enumerate(rsus)
        ]
    )


def wide(x: float, y: float, sd_m: float = 10.0) -> tuple[Array, Array]:
    cov = np.diag([sd_m**2, 1.44 * sd_m**2, 1.0, 1.0, 1.0, 1.0])
    cov[X.PX, X.VX] = cov[X.VX, X.PX] = 0.5 * sd_m
    return np.array([x, y, 1.0, 0.0, 0.0, 0.0]), cov


def places(
    mean: Array, cov: Array, rows: Array, starts: tuple[float, ...] = AROUND
) -> list[tuple[float, Array, Array]]:
    """The places where the rows and the prior agree best: cost, state, covariance, best first, by
    SciPy from a grid of starts."""
    root = np.linalg.inv(np.linalg.cholesky(cov))

    def residuals(x: Array) -> Array:
        innovation, _ = linearise(rows, x, 0.0)
        return np.concatenate([root @ (x - mean), innovation / np.sqrt(rows[:, VARIANCE])])

    found: list[tuple[float, Array, Array]] = []
    sd = np.sqrt(np.diag(cov))
    for dx, dy in product(starts, starts):
        start = mean.copy()
        start[POSITION] += dx * sd[0], dy * sd[1]
        fit = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        if all(math.dist(fit.x[:2], x[POSITION]) > 1e-3 for _, x, _ in found):
            found.append((2.0 * fit.cost, fit.x, np.linalg.inv(fit.jac.T @ fit.jac)))
    return sorted(found, key=lambda one: one[0])


def cautious(mean: Array, cov: Array, rows: Array) -> tuple[Array, Array]:
    """What an update does that trusts the curvature of the prior: iterated where this adds a tenth
    to a row's variance, or a row leaves its tangent by more than 2 % of its sd."""
    variance = two_variances(mean, cov, rows)
    innovation, H = linearise(rows, mean, 0.0)
    x, P, _ = fused(mean, cov, innovation - bends(mean, cov, rows), H, variance)
    away = linearise(rows, x, 0.0)[0] - innovation + H @ (x - mean)
    is_bent = np.abs(away) > 0.02 * np.sqrt(variance)
    if (is_bent | (variance > 1.1 * rows[:, VARIANCE])).any():
        at_mean = rows.copy()
        at_mean[:, VALUE] -= bends(x, P, rows)
        return iterated(mean, cov, at_mean, variance, 8)
    return x, P


def is_refined(mean: Array, cov: Array, rows: Array) -> bool:
    """Whether an update ends at the best place of all with its covariance; else it is the cautious
    one but for rounding."""
    x, P, *_ = updated(mean, cov, rows, 0.0, NO_GATE, 8)
    expected, expected_cov = cautious(mean, cov, rows)
    rounding = 1e-9 * np.sqrt(np.diag(expected_cov))
    if (np.abs(x - expected) < rounding).all() and np.allclose(P, expected_cov, rtol=1e-9):
        return False
    _, best, best_cov = places(mean, cov, rows)[0]
    sd = np.sqrt(np.diag(best_cov))
    np.testing.assert_allclose((x - best) / sd, 0.0, atol=0.02)
    np.testing.assert_allclose(P / np.outer(sd, sd), best_cov / np.outer(sd, sd), atol=0.02)
    return True


TRIANGLE = [(-20.0, 0.0), (25.0, -5.0), (3.0, 30.0)]


@pytest.mark.parametrize("place", [(4.0, 3.0), (-6.0, -9.0), (9.0, 8.0)])
def test_the_only_place_left_is_taken(place: tuple[float, float]) -> None:
    """Three precise ranges to a device 10 m uncertain: the cautious update stays metres wide."""
    mean, cov = wide(0.0, 0.0)
    rows = ranges(place, TRIANGLE, 0.1)
    assert is_refined(mean, cov, rows)
    x, P, _, nis, used = updated(mean, cov, rows, 0.0, NO_GATE, 8)
    assert math.dist(x[POSITION], place) < 0.05
    assert P[X.PX, X.PX] < 0.02 < 0.05 * cautious(mean, cov, rows)[1][0, 0]
    assert (nis, used) == updated(mean, cov, rows, 0.0, NO_GATE, 1)[3:]  # those of the prior
    innovation, H = linearise(rows, mean, 0.0)
    plain = fused(mean, cov, innovation, H, two_variances(mean, cov, rows))
    np.testing.assert_allclose(updated(mean, cov, rows, 0.0, NO_GATE, 1)[1], plain[1], rtol=1e-12)


def test_what_was_rejected_has_no_part_in_it() -> None:
    """A range 1 km off stands first; it names another place and makes the search hopeless."""
    mean, cov = wide(0.0, 0.0)
    rows = ranges((4.0, 3.0), TRIANGLE, 0.1)
    liar = rows[0].copy()
    liar[VALUE] += 1e3
    both = np.vstack([liar, rows])
    both[:, GROUP] = range(4)
    x, P, accepted, *_ = updated(mean, cov, both, 0.0, np.array([0.0, 99.0]), 8)
    assert accepted.tolist() == [0.0, 1.0, 1.0, 1.0]
    expected = updated(mean, cov, rows, 0.0, NO_GATE, 8)
    np.testing.assert_allclose(x, expected[0], rtol=1e-12)
    np.testing.assert_allclose(P, expected[1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("odds", "taken"), [(14.9, False), (15.1, True)])
def test_another_place_must_be_ruled_out(odds: float, taken: bool) -> None:
    """Two ranges leave two places on either side; the prior says which, more or less surely."""
    rsus = [(-20.0, 0.0), (22.0, 0.0)]
    rows = ranges((1.0, 36.0), rsus, 0.1)

    def advantage(y: float) -> float:
        (best, here, _), (other, there, _) = places(*wide(0.0, y), rows)[:2]
        assert math.dist(here[POSITION], there[POSITION]) > 60.0
        return other - best

    y = brentq(lambda y: advantage(y) - odds, 10.0, 17.5, xtol=1e-4)
    assert is_refined(*wide(0.0, y), rows) is taken


@pytest.mark.parametrize(("cost", "taken"), [(23.9, True), (24.1, False)])
def test_the_place_must_explain_the_rows(cost: float, taken: bool) -> None:
    """Ranges that contradict each other more and more, up to 8 for each."""
    mean, cov = wide(0.0, 0.0)

    def off(by_m: float) -> Array:
        rows = ranges((4.0, 3.0), TRIANGLE, 0.1)
        rows[:, VALUE] += by_m
        return rows

    by_m = brentq(lambda d: places(mean, cov, off(d), ALONE)[0][0] - cost, 0.0, 2.0, xtol=1e-6)
    assert is_refined(mean, cov, off(by_m)) is taken


@pytest.mark.parametrize(("share", "taken"), [(0.095, True), (0.105, False)])
def test_the_model_must_be_straight_over_what_is_left(share: float, taken: bool) -> None:
    """A tenth of a row's variance, of a nearby RSU whose range says little."""
    mean, cov = wide(0.0, 0.0)

    def problem(sd_m: float) -> Array:
        rows = ranges((4.0, 3.0), [(3.0, 5.0), *TRIANGLE], sd_m)
        rows[0, VARIANCE] = 0.5**2
        return rows

    def bend(sd_m: float) -> float:
        rows = problem(sd_m)
        _, x, P = places(mean, cov, rows, ALONE)[0]
        return max(curvature_variance(r, x, P, 0.0) / r[VARIANCE] for r in rows)

    sd_m = brentq(lambda s: bend(s) - share, 0.1, 2.0, xtol=1e-6)
    assert is_refined(mean, cov, problem(sd_m)) is taken


@pytest.mark.parametrize(("left", "taken"), [(0.249, True), (0.251, False)])
def test_the_rows_must_narrow_the_prior(left: float, taken: bool) -> None:
    """To a quarter of the position's variance, by the tangent and without the curvature."""
    mean, cov = wide(0.0, 0.0)
    mean[X.PY] = 12.0

    def problem(sd_m: float) -> Array:
        rows = ranges((3.0, 14.0), [(-200.0, 0.0), (15.0, 260.0)], 1.0)
        rows[1, VARIANCE] = sd_m**2
        return rows

    def share(sd_m: float) -> float:
        rows = problem(sd_m)
        innovation, H = linearise(rows, mean, 0.0)
        _, P, _ = fused(mean, cov, innovation, H, rows[:, VARIANCE].copy())
        return float((P[X.PX, X.PX] + P[X.PY, X.PY]) / (cov[X.PX, X.PX] + cov[X.PY, X.PY]))

    sd_m = brentq(lambda s: share(s) - left, 0.1, 100.0, xtol=1e-9)
    assert is_refined(mean, cov, problem(sd_m)) is taken


@pytest.mark.parametrize(("share", "is_so"), [(1.099, False), (1.101, True)])
def test_a_prior_is_wide_by_the_curvature_of_a_row_used(share: float, is_so: bool) -> None:
    rows = ranges((4.0, 3.0), TRIANGLE, 0.1)
    work = scratch(6, 3)
    work[fusion.W_VARIANCE, :3] = rows[:, VARIANCE]
    work[fusion.W_USE, :3] = 1.0, 0.0, 1.0
    work[fusion.W_VARIANCE, 1] *= 9.0  # not used
    assert not is_wide(rows, work)
    work[fusion.W_VARIANCE, 2] *= share
    assert is_wide(rows, work) is is_so


def search_by_the_rule(mean: Array, cov: Array, rows: Array) -> tuple[Array, Array] | None:
    """The best place from the cautious one and from eight around the prior, or None; what the
    starts find is that of ``iterate_from``."""
    variance, width = rows[:, VARIANCE].copy(), cov[X.PX, X.PX] + cov[X.PY, X.PY]
    innovation, H = linearise(rows, mean, 0.0)
    narrowed = fused(mean, cov, innovation, H, variance)[1]
    if narrowed[X.PX, X.PX] + narrowed[X.PY, X.PY] > 0.25 * width:
        return None
    circle = np.exp(2j * np.pi * np.arange(8) / 8)
    starts = [cautious(mean, cov, rows)[0], *(mean.copy() for _ in circle)]
    for start, way in zip(starts[1:], circle, strict=True):
        start[POSITION] += 1.5 * np.sqrt(np.diag(cov)[:2]) * (way.real, way.imag)
    work = scratch(6, len(rows))
    ends = [ekf.iterate_from(s, mean, cov, rows, variance, 0.0, 30, work) for s in starts]
    costs = [log_posterior_cost(rows, mean, cov, 0.0, x) for x, _ in ends]
    best = int(np.argmin(costs))
    x, P = ends[best]
    apart = [
        c
        for c, (y, _) in zip(costs, ends, strict=True)
        if math.dist(y[POSITION], x[POSITION]) > 0.1
    ]
    bends = [curvature_variance(r, x, P, 0.0) > 0.1 * r[VARIANCE] for r in rows]
    if min(apart, default=math.inf) - costs[best] < 15.0 or costs[best] > 8.0 * len(rows):
        return None
    return None if any(bends) else (x, P)


def random_ranges(rng: np.random.Generator, mean: Array, cov: Array, sds_m: Array) -> Array:
    """Ranges of RSUs in the midst of the prior to a place drawn from it."""
    x, y = rng.multivariate_normal(mean[POSITION], cov[POSITION, POSITION])
    rows = ranges((x, y), [tuple(rng.uniform(-12, 12, 2)) for _ in sds_m], 1.0)
    rows[:, VARIANCE] = sds_m**2
    rows[:, VALUE] += rng.normal(0.0, sds_m)
    return rows


def assert_follows_the_rule(mean: Array, cov: Array, rows: Array) -> bool:
    """Returns whether the search's place is taken."""
    found = search_by_the_rule(mean, cov, rows)
    expected, P_expected = cautious(mean, cov, rows) if found is None else found
    x, P, *_ = updated(mean, cov, rows, 0.0, NO_GATE, 8)
    sd = np.sqrt(np.diag(P_expected))
    np.testing.assert_allclose((x - expected) / sd, 0.0, atol=0.02)
    np.testing.assert_allclose((P - P_expected) / np.outer(sd, sd), 0.0, atol=0.02)
    return found is not None


def test_the_search_starts_all_around() -> None:
    """Two or three precise ranges: what is found from which start decides."""
    taken = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        mean, cov = wide(0.0, 0.0)
        count = int(rng.integers(2, 4))
        taken += assert_follows_the_rule(
            mean, cov, random_ranges(rng, mean, cov, np.full(count, 0.2))
        )
    assert 8 < taken < 32


def test_a_better_place_than_the_cautious_one_is_found() -> None:
    """The third range, less precise, leaves the wrong side a place of its own; some of the
    cautious updates end there."""
    misled = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        mean, cov = wide(0.0, 0.0)
        rows = random_ranges(rng, mean, cov, np.array([0.2, 0.2, rng.uniform(0.5, 4.0)]))
        if assert_follows_the_rule(mean, cov, rows):
            x, *_ = updated(mean, cov, rows, 0.0, NO_GATE, 8)
            misled += math.dist(x[POSITION], cautious(mean, cov, rows)[0][:2]) > 4.0
    assert misled >= 2


@pytest.mark.parametrize(("seed", "eighths", "loose"), [(3, 7, 1.5), (3, 7, 3.0), (13, 0, 1.0)])
def test_a_rival_that_is_left_for_a_better_place_still_counts(
    seed: int, eighths: int, loose: float
) -> None:
    """Turned so that no start after the one that finds the better place comes upon the rival."""
    rng = np.random.default_rng(seed)
    mean, cov = np.array([0.0, 0, 1, 0, 0, 0]), np.diag([100.0, 100, 1, 1, 1, 1])
    place = rng.multivariate_normal(mean[POSITION], cov[POSITION, POSITION])
    rsus = rng.uniform(-12, 12, (3, 2))
    sds = np.array([0.2, 0.2, rng.uniform(0.5, 4.0)])
    noise = rng.normal(0.0, sds)
    c, s = math.cos(eighths * math.pi / 4), math.sin(eighths * math.pi / 4)
    turn = np.array([[c, s], [-s, c]])
    x, y = place @ turn
    rows = ranges((x, y), [(a, b) for a, b in rsus @ turn], 1.0)
    rows[:, VALUE] += noise
    rows[:, VARIANCE] = (sds * [1.0, 1.0, loose]) ** 2
    (best, there, _), (rival, _, _) = places(mean, cov, rows)[:2]
    assert rival - best < 15.0
    assert math.dist(there[POSITION], cautious(mean, cov, rows)[0][:2]) > 4.0
    assert not is_refined(mean, cov, rows)
