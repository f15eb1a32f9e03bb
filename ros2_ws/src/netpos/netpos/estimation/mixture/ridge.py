"""A posterior around its most probable states, as a Gaussian mixture.

Ranges of near anchors, or an angle and few ranges, leave a thin arc: long one way, narrow across,
and bent. One Gaussian at its most probable point is too short, too thick or off. Here the arc is
followed from that point both ways, and becomes a row of Gaussians, each so short that its
second-order variance is a twentieth of the variance across (Tuggle and Zanetti 2018 split along
the direction of greatest curvature, too). Each is the product of the posterior and of a Gaussian
along the arc, by Laplace's approximation: the Gaussians along the arc add up to a constant, so
that the products add up to the posterior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from netpos.common.least_squares import minimise
from netpos.estimation.mixture.gaussians import CURVATURE_SHARE, SPACING_SD, Mixture
from netpos.estimation.state import POSITION, VELOCITY
from netpos.messages.values import Array

Fit = tuple[float, Array, Array]
"""Cost, state (n,) and covariance (n, n) of a minimum."""
Equations = Callable[[Array], tuple[float, Array, Array]]
"""Cost, gradient (n,) and normal matrix (n, n) at a state, as ``minimise`` takes them."""

# A cost one sd away that differs by so much from the one of a Gaussian (1) shifts the mean by 1.5
# times as many sd, where it is higher on one side.
_UNEVEN = 0.05
_TIGHT = 0.01  # sd, over a component's, that holds a point at its place along the arc
_COST_MAX = 37.0  # twice the log of the least weight of a component
_PIECES_MAX = 32  # one way from the most probable point
_SAME2 = 9.0  # squared Mahalanobis distance within which a minimum belongs to a component
_PLACE = slice(POSITION.start, VELOCITY.stop)


class _Piece(NamedTuple):
    log_weight: float
    mean: Array
    cov: Array


class _Line(NamedTuple):
    """A Gaussian of ``sd`` along ``direction`` (2,) about ``centre`` (2,)."""

    centre: Array
    direction: Array
    sd: float


def components_of(
    equations: Equations, fits: Sequence[Fit], is_possible: Callable[[Array], bool]
) -> Mixture:
    """The posterior with the cost of ``equations``, of which ``fits`` are the minima, best first;
    log weights are not normalised.

    is_possible : whether the device may be in a state; components that are not are left out
    """
    pieces: list[_Piece] = []
    for fit in fits:
        if fit[0] <= fits[0][0] + _COST_MAX and not _is_known(fit[1], pieces):
            limit = fits[0][0] + _COST_MAX
            pieces += [p for p in _along(equations, fit, limit) if is_possible(p.mean)]
    if not pieces:
        pieces = [_whole(fits[0])]
    return Mixture(
        np.array([p.mean for p in pieces]),
        np.array([p.cov for p in pieces]),
        np.array([p.log_weight for p in pieces]),
    )


def inverse(A: Array) -> Array:
    """Inverse of a positive definite matrix whose units differ by many orders of magnitude."""
    scale = 1.0 / np.sqrt(np.diag(A))
    scaling = np.outer(scale, scale)
    # 1e-14 is rounding: it keeps inv from calling singular what is only ill-conditioned.
    inverted: Array = np.linalg.inv(A * scaling + 1e-14 * np.eye(len(A))) * scaling
    return inverted


def _log_det(cov: Array) -> float:
    sd = np.sqrt(np.diag(cov))
    return float(2.0 * np.log(sd).sum() + np.linalg.slogdet(cov / np.outer(sd, sd))[1])


def log_weight_of(fit: Fit) -> float:
    """Log weight of a minimum as one Gaussian, by Laplace's approximation."""
    cost, _, cov = fit
    return -0.5 * cost + 0.5 * _log_det(2.0 * math.pi * cov)


def _whole(fit: Fit) -> _Piece:
    """A minimum as one Gaussian."""
    _, mean, cov = fit
    return _Piece(log_weight_of(fit), mean, cov)


def _is_known(state: Array, pieces: list[_Piece]) -> bool:
    """Whether a minimum lies within a component there is."""
    for piece in pieces:
        away = state[_PLACE] - piece.mean[_PLACE]
        if float(away @ inverse(piece.cov[_PLACE, _PLACE]) @ away) < _SAME2:
            return True
    return False


def _minimum(equations: Equations, line: _Line, start: Array) -> Fit:
    """The minimum, from ``start``, of the cost and that of a Gaussian along a line."""
    u, weight = line.direction, 1.0 / line.sd**2

    def held(state: Array) -> tuple[float, Array, Array]:
        cost, b, A = equations(state)
        off = float(u @ (line.centre - state[POSITION]))
        b, A = b.copy(), A.copy()
        b[POSITION] += weight * off * u
        A[POSITION, POSITION] += weight * np.outer(u, u)
        return cost + weight * off * off, b, A

    cost, state, A = minimise(held, start, lambda A, b: inverse(A) @ b)
    return cost, state, inverse(A)


def _axis(cov: Array) -> tuple[float, Array, Array, float]:
    """Of the position: sd and direction (2,) along which it is widest, how the state (n,) follows
    a metre that way, and the sd across."""
    values, vectors = np.linalg.eigh(cov[POSITION, POSITION])
    u = vectors[:, 1]
    follows = cov[:, POSITION] @ u / values[1]
    return math.sqrt(values[1]), u, follows, math.sqrt(max(values[0], 0.0))


def _along(equations: Equations, fit: Fit, cost_max: float) -> list[_Piece]:
    """Components of the arc through a minimum; one where it is straight."""
    sd, u, follows, across = _axis(fit[2])
    bend, differs = 0.0, False
    for side in (-sd, sd):
        q = fit[1] + side * follows
        cost, state, _ = _minimum(equations, _Line(q[POSITION], u, _TIGHT * sd), q)
        away = state[POSITION] - fit[1][POSITION]
        bend += float(away[1] * u[0] - away[0] * u[1]) / sd**2
        differs |= abs(cost - fit[0] - 1.0) > _UNEVEN
    is_bent = 0.5 * bend**2 * sd**4 > CURVATURE_SHARE * across**2
    if not is_bent and not differs:
        return [_whole(fit)]
    short = min(
        math.sqrt(math.sqrt(2.0 * CURVATURE_SHARE) * across / max(abs(bend), 1e-9)), 0.5 * sd
    )
    pieces = [_piece(equations, _Line(fit[1][POSITION], u, short), fit[1])]
    for side in (-1.0, 1.0):
        pieces += _one_way(equations, fit, side * u, short, cost_max)
    return pieces


def _one_way(
    equations: Equations, fit: Fit, towards: Array, short: float, cost_max: float
) -> list[_Piece]:
    """Components of the sd ``short`` along the arc that leaves a minimum ``towards`` (2,)."""
    pieces: list[_Piece] = []
    state, cov = fit[1], fit[2]
    for _ in range(_PIECES_MAX):
        _, u, follows, _ = _axis(cov)
        side = 1.0 if float(u @ towards) > 0.0 else -1.0
        towards = side * u
        q = state + SPACING_SD * short * side * follows
        line = _Line(q[POSITION], towards, _TIGHT * short)
        cost, state, _ = _minimum(equations, line, q)
        if not math.isfinite(cost) or cost > cost_max:
            break
        cov = inverse(equations(state)[2])
        u = _axis(cov)[1]
        pieces.append(_piece(equations, _Line(state[POSITION], u, short), state))
    return pieces


def _piece(equations: Equations, line: _Line, start: Array) -> _Piece:
    """The product of the posterior and of a Gaussian along the arc, times their spacing."""
    whole = _whole(_minimum(equations, line, start))
    return whole._replace(
        log_weight=whole.log_weight + math.log(SPACING_SD / math.sqrt(2.0 * math.pi))
    )
