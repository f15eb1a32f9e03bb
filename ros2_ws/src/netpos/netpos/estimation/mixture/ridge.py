"""A posterior around its most probable states, as a Gaussian mixture.

Ranges of near anchors, or an angle and few ranges, leave a thin arc: long one way, narrow across,
and bent. One Gaussian at its most probable point is too short, too thick or off. Here the arc is
followed from that point both ways, and becomes a row of Gaussians, each so short that its
second-order variance is a twentieth of the variance across (Tuggle and Zanetti 2018 split along
the direction of greatest curvature, too), and that the arc is hardly wider at one end than at the
other: along a ray they become longer with the distance (Peach 1995 covers a range so). Each is the
product of the posterior and of a Gaussian along the arc, by Laplace's approximation: the Gaussians
along the arc add up to a constant, so that the products add up to the posterior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from netpos.estimation.factor import inverse
from netpos.estimation.mixture.gaussians import CURVATURE_SHARE, SPACING_SD, Mixture
from netpos.estimation.state import POSITION, VELOCITY
from netpos.messages.values import Array

Fit = tuple[float, Array, Array]
"""Cost, state (n,) and covariance (n, n) of a minimum."""


class Line(NamedTuple):
    """A Gaussian of ``sd`` along ``direction`` (2,) about ``centre`` (2,)."""

    centre: Array
    direction: Array
    sd: float


class Posterior(Protocol):
    """A density of states (n,), by its cost, twice its negative log."""

    def equations(self, state: Array) -> tuple[float, Array, Array]:
        """Cost, gradient (n,) and normal matrix (n, n) at a state."""

    def minimum(self, start: Array, line: Line | None = None) -> tuple[float, Array, Array]:
        """Cost, state and normal matrix (n, n) of the minimum to which ``start`` (n,) leads, with
        those of a ``line``, where there is one."""


# A cost one sd away that differs by so much from the one of a Gaussian (1) shifts the mean by 1.5
# times as many sd, where it is higher on one side.
_UNEVEN = 0.05
_WIDENING = 0.2  # of the width across: how much it may change one sd along a component
_LENGTH_RATIO = 1.25  # by how much a component may be longer or shorter than the one before
_TIGHT = 0.01  # sd, over a component's, that holds a point at its place along the arc
_COST_MAX = 37.0  # twice the log of the least weight of a component
_PIECES_MAX = 32  # one way from the most probable point
_SAME2 = 9.0  # squared Mahalanobis distance within which a minimum belongs to a component
_SIDES = (-1.0, 1.0)
_PLACE = slice(POSITION.start, VELOCITY.stop)


class _Piece(NamedTuple):
    log_weight: float
    mean: Array
    cov: Array


def components_of(
    posterior: Posterior,
    minima: Sequence[Fit],
    constrained: Sequence[Fit],
    is_possible: Callable[[Array], bool],
) -> Mixture | None:
    """The posterior; log weights are not normalised.

    minima, constrained : where the cost is least, and where it is at a given distance, which
        ``on_line`` finds; arcs are followed from the latter as far as none has led from the former
    is_possible : whether the device may be in a state; components that are not are left out, None
        where that leaves nothing
    """
    pieces: list[_Piece] = []
    limit = min(cost for cost, _, _ in (*minima, *constrained)) + _COST_MAX
    for fits in (minima, constrained):
        for fit in sorted(fits, key=log_weight_of, reverse=True):
            if fit[0] > limit or _is_known(fit[1], pieces):
                continue
            along = _along(posterior, fit, limit, partial(_is_end, is_possible, tuple(pieces)))
            if along is None:  # one Gaussian describes it, about its minimum
                along = [_whole(fit)] if fits is minima else []
            pieces += along
    pieces = [piece for piece in pieces if is_possible(piece.mean)]
    if not pieces:
        return None
    return Mixture(
        np.array([p.mean for p in pieces]),
        np.array([p.cov for p in pieces]),
        np.array([p.log_weight for p in pieces]),
    )


def across(state: Array, direction: Array) -> Line:
    """The line that keeps the position where it is in a ``state`` (n,) along ``direction``
    (2,)."""
    return Line(state[POSITION], direction, _TIGHT)


def on_line(posterior: Posterior, start: Array, line: Line) -> Fit:
    """The most probable state on a line to which ``start`` (n,) leads, and the covariance (n, n)
    there without the line."""
    _, state, _ = posterior.minimum(start, line)
    cost, _, A = posterior.equations(state)
    return cost, state, inverse(A)


def _log_det(cov: Array) -> float:
    sd = np.sqrt(np.diag(cov))
    return float(2.0 * np.log(sd).sum() + np.linalg.slogdet(cov / np.outer(sd, sd))[1])


def log_weight_of(fit: Fit) -> float:
    """Log weight of a minimum as one Gaussian, by Laplace's approximation."""
    cost, _, cov = fit
    return -0.5 * cost + 0.5 * _log_det(2.0 * math.pi * cov)


def _fit(posterior: Posterior, start: Array, line: Line) -> Fit:
    cost, state, A = posterior.minimum(start, line)
    return cost, state, inverse(A)


def _whole(fit: Fit) -> _Piece:
    """A minimum as one Gaussian."""
    _, mean, cov = fit
    return _Piece(log_weight_of(fit), mean, cov)


def _is_known(state: Array, pieces: Sequence[_Piece]) -> bool:
    """Whether a minimum lies within a component there is."""
    for piece in pieces:
        away = state[_PLACE] - piece.mean[_PLACE]
        if float(away @ inverse(piece.cov[_PLACE, _PLACE]) @ away) < _SAME2:
            return True
    return False


def _is_end(is_possible: Callable[[Array], bool], known: Sequence[_Piece], state: Array) -> bool:
    """Whether an arc ends at a state."""
    return not is_possible(state) or _is_known(state, known)


def _axis(cov: Array) -> tuple[float, Array, Array, float]:
    """Of the position: sd and direction (2,) along which it is widest, how the state (n,) follows
    a metre that way, and the sd across."""
    values, vectors = np.linalg.eigh(cov[POSITION, POSITION])
    u = vectors[:, 1]
    follows = cov[:, POSITION] @ u / values[1]
    return math.sqrt(values[1]), u, follows, math.sqrt(max(values[0], 0.0))


def _along(
    posterior: Posterior, fit: Fit, cost_max: float, ends: Callable[[Array], bool]
) -> list[_Piece] | None:
    """Components of the arc through a state on it, as far as where it ``ends``; None where it is
    straight and as wide all along."""
    sd, u, follows, across = _axis(fit[2])

    def beside(off: float) -> Fit:
        q = fit[1] + off * follows
        return posterior.minimum(q, Line(q[POSITION], u, _TIGHT * abs(off)))

    wider = [
        side * (_across(posterior, beside(side * across)[1]) / across - 1.0) for side in _SIDES
    ]
    widening = min(wider, key=abs) / across  # the other may be that of another arc
    step = min(sd, _WIDENING / max(abs(widening), 1e-9))
    bend, differs = 0.0, step < sd
    for side in (-step, step):
        cost, state, _ = beside(side)
        away = state[POSITION] - fit[1][POSITION]
        bend += float(away[1] * u[0] - away[0] * u[1]) / step**2
        differs |= abs(cost - fit[0] - (step / sd) ** 2) > _UNEVEN
    is_bent = 0.5 * bend**2 * sd**4 > CURVATURE_SHARE * across**2
    if not is_bent and not differs:
        return None
    short = min(_length(sd, across, abs(bend), widening), step)
    pieces = [_piece(posterior, Line(fit[1][POSITION], u, short), fit[1], widening)]
    if ends(pieces[0].mean):
        return []
    for side in _SIDES:
        for piece in _one_way(posterior, fit, side * u, short, cost_max):
            if ends(piece.mean):
                break
            pieces.append(piece)
    return pieces


def _across(posterior: Posterior, state: Array) -> float:
    """The sd across at a ``state`` (n,) of the arc."""
    return _axis(inverse(posterior.equations(state)[2]))[3]


def _length(sd: float, across: float, bend: float, widening: float) -> float:
    """Sd of a component of an arc of ``sd`` along and ``across``, that turns by ``bend`` [1/m] and
    becomes wider by the share ``widening`` [1/m]."""
    by_bend = math.sqrt(math.sqrt(2.0 * CURVATURE_SHARE) * across / max(bend, 1e-9))
    return min(by_bend, 0.5 * sd, _WIDENING / max(abs(widening), 1e-9))


def _one_way(
    posterior: Posterior, fit: Fit, towards: Array, short: float, cost_max: float
) -> Iterator[_Piece]:
    """Components along the arc that leaves a minimum ``towards`` (2,), the first of about the sd
    ``short``."""
    _, state, cov = fit
    _, u, follows, across = _axis(cov)
    for _ in range(_PIECES_MAX):
        side = 1.0 if float(u @ towards) > 0.0 else -1.0
        towards = side * u
        q = state + SPACING_SD * short * side * follows
        cost, new, _ = posterior.minimum(q, Line(q[POSITION], towards, _TIGHT * short))
        if not math.isfinite(cost) or cost > cost_max:
            break
        sd, u, follows, wide = _axis(inverse(posterior.equations(new)[2]))
        if wide == 0.0:  # lost to rounding: the device is on top of an RSU
            break
        moved = float(np.hypot(*(new - state)[POSITION]))
        turned = abs(float(u[0] * towards[1] - u[1] * towards[0]))
        widening = math.log(wide / across) / moved
        length, before = _length(sd, wide, turned / moved, widening), short
        short = min(max(length, short / _LENGTH_RATIO), short * _LENGTH_RATIO)
        piece = _piece(posterior, Line(new[POSITION], towards, short), new, widening)
        share = math.log(0.5 * (before + short) / short)  # of the constant that all add up to
        yield piece._replace(log_weight=piece.log_weight + share)
        state, across = new, wide


def _piece(posterior: Posterior, line: Line, start: Array, widening: float) -> _Piece:
    """The product of the posterior and of a Gaussian along the arc, times their spacing. The arc
    becomes wider along the line by the share ``widening`` [1/m]: there is more of it that way."""
    log_weight, mean, cov = _whole(_fit(posterior, start, line))
    pull = cov[:, POSITION] @ (widening * line.direction)
    log_weight += math.log(SPACING_SD / math.sqrt(2.0 * math.pi))
    log_weight += 0.5 * widening * float(line.direction @ pull[POSITION])
    return _Piece(log_weight, mean + pull, cov)
