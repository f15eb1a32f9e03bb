"""What a shift of the position and of the clock leaves of the residuals of several RSUs, heard
while the device moves: generalised least squares, with a way that is known as well as the motion
model says.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netpos.estimation.measurement import BIAS, HEIGHT, REFERENCE, VALUE, linearise
from netpos.estimation.state import X
from netpos.messages.values import Array

_STEPS = 10
_HALVINGS = 4
_SMALL = 1e-3  # sd: a step that changes no residual by more
_UNSEEN = 1e-6  # of the largest singular value
_PLACE = [int(X.PX), int(X.PY), int(X.CLOCK)]
_CHANGE = [int(X.VX), int(X.VY), int(X.DRIFT)]


class DeviceState(NamedTuple):
    """What a track believes at ``stamp_ns``: mean (n,), cov (n, n) of the state; ``height_m``:
    nominal height in map; ``accel_density`` [m/s^2/sqrt(Hz)] of the white acceleration."""

    stamp_ns: int
    mean: Array
    cov: Array
    height_m: float
    accel_density: float


class Way(NamedTuple):
    """By how much the device may have moved otherwise than straight ahead until m means of values
    were heard.

    since_s : (m,) since the velocity was known with change_cov (3, 3), of velocity and clock drift
    wander : (m, m) covariance of what accelerating has changed of each coordinate [m^2]
    """

    since_s: Array
    change_cov: Array
    wander: Array

    @classmethod
    def of(cls, stamps_ns: Array, weights: Array, before: DeviceState) -> Way:
        """Of m means with ``weights`` (m, N) of values of ``stamps_ns`` (N,), heard after a
        posterior: velocities are a random walk from it on."""
        epochs_ns, epoch = np.unique(stamps_ns, return_inverse=True)
        of_epoch = np.zeros((len(weights), len(epochs_ns)))
        np.add.at(of_epoch.T, epoch, weights.T)
        since_s = (epochs_ns - before.stamp_ns) * 1e-9
        early, late = np.minimum.outer(since_s, since_s), np.maximum.outer(since_s, since_s)
        wander = before.accel_density**2 * early**2 * (3.0 * late - early) / 6.0
        change_cov = before.cov[np.ix_(_CHANGE, _CHANGE)]
        return cls(of_epoch @ since_s, change_cov, of_epoch @ wander @ of_epoch.T)

    def covariance(self, H: Array) -> Array:
        """Of the m values: (m, m), with the Jacobian H (m, n) of their rows."""
        along = H[:, _PLACE]
        changed = along @ self.change_cov @ along.T * np.outer(self.since_s, self.since_s)
        return changed + along[:, :2] @ along[:, :2].T * self.wander


def residuals_on(way: tuple[DeviceState, DeviceState], rows: Array, stamps_ns: Array) -> Array:
    """What ``rows`` (N, ROW_WIDTH) of ``stamps_ns`` (N,) say more than would be measured on a
    straight way with the velocity of the first posterior to the place of the second one; the
    biases of the RSUs are in it."""
    (before, after), rows, left = way, _with_biases(rows), np.empty(len(rows))
    for stamp_ns in np.unique(stamps_ns):
        then, at = after.mean.copy(), stamps_ns == stamp_ns
        then[_PLACE] -= (after.stamp_ns - stamp_ns) * 1e-9 * before.mean[_CHANGE]
        left[at], _ = linearise(rows[at], then, after.height_m)
    return left


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


def unshifted(
    rows: Array, residuals: Array, sd: Array, way: Way, after: DeviceState, beside: Array
) -> Left:
    """What the best shift from the place of ``after`` leaves of residuals (m,), and of others
    ``beside`` (m,).

    rows : (m, ROW_WIDTH), one per RSU and quantity; their biases are in the residuals
    sd : (m,) of what is wrong with each

    Least squares by Gauss and Newton, with steps halved until they help. A linear projection would
    do near the truth only: two metres beside it an angle to an RSU three metres away has turned by
    a third, and what is left of it looks like an error of the RSU.
    """
    rows, shifted = _with_biases(rows), _PLACE
    height = int(rows[:, HEIGHT].max())
    if height > 0:  # one that is unknown may explain a residual, too
        shifted = [*_PLACE, height]
    innovation, H = linearise(rows, after.mean, after.height_m)
    rows[:, VALUE] += residuals - innovation
    place, whiten = after.mean.copy(), _whitening(H, sd, way)
    left = whiten @ residuals
    for _ in range(_STEPS):
        step = _step(whiten @ H[:, shifted], left)
        if np.abs(whiten @ H[:, shifted] @ step).max() < _SMALL:
            break
        for halved in range(_HALVINGS):
            trial = place.copy()
            trial[shifted] += step / 2.0**halved
            innovation, trial_H = linearise(rows, trial, after.height_m)
            trial_left = whiten @ innovation
            if trial_left @ trial_left < left @ left:
                break
        else:
            break
        place, left, H = trial, trial_left, trial_H
    whiten = _whitening(H, sd, way)
    left = whiten @ linearise(rows, place, after.height_m)[0]
    U = _seen(whiten @ H[:, shifted])[0]
    left, other = (a - U @ (U.T @ a) for a in (left, whiten @ beside))
    free = whiten - U @ (U.T @ whiten)
    checked = sd**2 * (free**2).sum(axis=0)
    student = sd**2 * (whiten.T @ left) / np.sqrt(np.maximum(checked, _UNSEEN))
    return Left(student, checked, left, other)


def _whitening(H: Array, sd: Array, way: Way) -> Array:
    """(m, m) that decorrelates residuals of ``sd`` (m,) which have the ``way`` in common, and
    changes each as little as that needs."""
    size, vectors = np.linalg.eigh(way.covariance(H) / np.outer(sd, sd))
    shrunk: Array = vectors / np.sqrt(1.0 + np.maximum(size, 0.0)) @ vectors.T
    return shrunk / sd


def _with_biases(rows: Array) -> Array:
    """Rows (m, ROW_WIDTH) that no bias state explains."""
    rows = rows.copy()
    rows[:, BIAS], rows[:, REFERENCE] = -1.0, 0.0
    return rows


def _seen(A: Array) -> tuple[Array, Array, Array]:
    """Singular value decomposition of A (m, k) without the directions that no row sees."""
    U, size, Vt = np.linalg.svd(A, full_matrices=False)
    kept = size > _UNSEEN * max(size.max(), 1e-12)
    return U[:, kept], size[kept], Vt[kept]


def _step(A: Array, left: Array) -> Array:
    """Shift (k,) that explains ``left`` (m,) by A (m, k)."""
    U, size, Vt = _seen(A)
    step: Array = Vt.T @ ((U.T @ left) / size)
    return step
