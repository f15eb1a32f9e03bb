"""What a shift of a device's way leaves of what several RSUs measured on it: generalised least
squares, with a way that is known as well as the motion model says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netpos.estimation.measurement import BIAS, HEIGHT, REFERENCE, linearise
from netpos.estimation.state import X
from netpos.messages.values import Array

_STEPS = 10
_HALVINGS = 4
_SMALL = 1e-3  # sd: a step that changes no residual by more
_UNSEEN = 1e-6  # of the largest singular value
_PLACE = [int(X.PX), int(X.PY), int(X.CLOCK)]
CHANGE = [int(X.VX), int(X.VY), int(X.DRIFT)]


class DeviceState(NamedTuple):
    """What a track believes at ``stamp_ns``: mean (n,), cov (n, n) of the state; ``height_m``:
    nominal height in map; ``accel_density`` [m/s^2/sqrt(Hz)] of the white acceleration."""

    stamp_ns: int
    mean: Array
    cov: Array
    height_m: float
    accel_density: float


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """Means of values that m RSUs and quantities measured on the way of a device.

    rows : (N, ROW_WIDTH) of the values, which no bias state explains
    mean_of, weights : (N,) in which of the means each value is, and with what weight
    begins : (E + 1,) with which row each instant begins
    to_go : (E, 3) from there to the end, x, y and the clock [m]; after : the state at the end
    since_s : (E,) since velocity and drift were known, with change_cov (3, 3)
    wander : (E, E) covariance of what a coordinate may have gone otherwise by accelerating [m^2]
    """

    rows: Array
    mean_of: NDArray[np.int64]
    weights: Array
    begins: list[int]
    to_go: Array
    since_s: Array
    change_cov: Array
    wander: Array
    after: DeviceState

    @classmethod
    def of(
        cls,
        rows: Array,
        means: tuple[NDArray[np.int64], Array],
        instants: Sequence[tuple[int, int]],
        to_go: Array,
        ends: tuple[DeviceState, DeviceState],
    ) -> Way:
        """Of ``rows`` (N, ROW_WIDTH), which are in ``means`` with their weights, (N,) each, in the
        order of E ``instants``: the stamp [ns] of each and its number of rows. ``to_go`` (E, 3);
        ``ends``: before and after."""
        rows = rows.copy()
        rows[:, BIAS], rows[:, REFERENCE] = -1.0, 0.0
        before, after = ends
        stamps_ns, counts = np.array(instants).T
        begins = [0, *np.cumsum(counts).tolist()]
        since_s = (stamps_ns - before.stamp_ns) * 1e-9
        early, late = np.minimum.outer(since_s, since_s), np.maximum.outer(since_s, since_s)
        wander = before.accel_density**2 * early**2 * (3.0 * late - early) / 6.0
        change_cov = before.cov[np.ix_(CHANGE, CHANGE)]
        return cls(rows, *means, begins, to_go, since_s, change_cov, wander, after)

    @property
    def shifted(self) -> list[int]:
        """The k states that may be wrong by the same all the way; a height that is unknown is one
        of them."""
        height = int(self.rows[:, HEIGHT].max())
        return [*_PLACE, height] if height > 0 else _PLACE

    def residuals(self, shift: Array) -> tuple[Array, Array]:
        """What the means (m,) say more than would be measured on the way shifted by ``shift``
        (k,), and the weighted Jacobian (m, E, k) of the values at each instant: its sum over all
        instants is that of the means."""
        shifted, height_m = self.shifted, self.after.height_m
        at_end = self.after.mean.copy()
        at_end[shifted] += shift
        left, H = np.empty(len(self.rows)), np.empty((len(self.rows), len(shifted)))
        for begin, end, to_go in zip(self.begins, self.begins[1:], self.to_go, strict=False):
            then = at_end.copy()
            then[_PLACE] -= to_go
            left[begin:end], of_all = linearise(self.rows[begin:end], then, height_m)
            H[begin:end] = of_all[:, shifted]
        instant = np.repeat(np.arange(len(self.to_go)), np.diff(self.begins))
        m = int(self.mean_of.max()) + 1
        said, jacobian = np.zeros(m), np.zeros((m, len(self.to_go), len(shifted)))
        np.add.at(said, self.mean_of, self.weights * left)
        np.add.at(jacobian, (self.mean_of, instant), self.weights[:, None] * H)
        return said, jacobian

    def covariance(self, jacobian: Array) -> Array:
        """Of the means, by how the device may have moved otherwise: (m, m), with their Jacobian
        (m, E, k) of ``residuals``. The velocity is a random walk from when it was known."""
        by_change = np.einsum("mek,e->mk", jacobian[:, :, : len(_PLACE)], self.since_s)
        x, y = jacobian[:, :, 0], jacobian[:, :, 1]
        cov: Array = by_change @ self.change_cov @ by_change.T
        return cov + x @ self.wander @ x.T + y @ self.wander @ y.T


class Left(NamedTuple):
    """What the best shift of the device leaves of residuals.

    residual : (m,) studentised, as if each scattered by its sd; checked : (m,) how much of a
    measurement it counts for, one minus its leverage where the way is known
    white, beside : (m,) residuals and others beside them, freed of the shift and decorrelated,
    over their sd
    """

    residual: Array
    checked: Array
    white: Array
    beside: Array


def unshifted(way: Way, more: Array, sd: Array, beside: Array) -> Left:
    """What the best shift of a way leaves of the residuals of its means and ``more`` (m,), and of
    others ``beside`` (m,); sd : (m,) of what is wrong with each.

    Least squares by Gauss and Newton, with steps halved until they help. A linear projection would
    do near the truth only: two metres beside it an angle to an RSU three metres away has turned by
    a third, and what is left of it looks like an error of the RSU.
    """
    place = np.zeros(len(way.shifted))
    said, jacobian = way.residuals(place)
    whiten = _whitening(way.covariance(jacobian), sd)
    for _ in range(_STEPS):
        A, left = whiten @ jacobian.sum(axis=1), whiten @ (said + more)
        step = np.linalg.lstsq(A, left, rcond=_UNSEEN)[0]
        if np.abs(A @ step).max() < _SMALL:
            break
        for halved in range(_HALVINGS):
            trial = place + step / 2.0**halved
            trial_said, trial_jacobian = way.residuals(trial)
            trial_left = whiten @ (trial_said + more)
            if trial_left @ trial_left < left @ left:
                break
        else:
            break
        place, said, jacobian = trial, trial_said, trial_jacobian
    whiten = _whitening(way.covariance(jacobian), sd)
    U, size, _ = np.linalg.svd(whiten @ jacobian.sum(axis=1), full_matrices=False)
    U = U[:, size > _UNSEEN * max(size.max(), 1e-12)]
    left, other = (a - U @ (U.T @ a) for a in (whiten @ (said + more), whiten @ beside))
    free = whiten - U @ (U.T @ whiten)
    checked = sd**2 * (free**2).sum(axis=0)
    student = sd**2 * (whiten.T @ left) / np.sqrt(np.maximum(checked, _UNSEEN))
    return Left(student, checked, left, other)


def _whitening(of_way: Array, sd: Array) -> Array:
    """(m, m) that decorrelates residuals of ``sd`` (m,) that have a way of covariance (m, m) in
    common, and changes each as little as that needs."""
    size, vectors = np.linalg.eigh(of_way / np.outer(sd, sd))
    shrunk: Array = vectors / np.sqrt(1.0 + np.maximum(size, 0.0)) @ vectors.T
    return shrunk / sd
