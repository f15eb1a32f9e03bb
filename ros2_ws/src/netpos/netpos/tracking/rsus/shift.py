"""What a shift of the position and of the clock leaves of the residuals of several RSUs."""

from __future__ import annotations

import numpy as np

from netpos.estimation.measurement import BIAS, HEIGHT, REFERENCE, VALUE, linearise
from netpos.estimation.state import X
from netpos.messages.values import Array

_STEPS = 10
_HALVINGS = 4
_SMALL = 1e-3  # sd: a step that changes no residual by more
_UNSEEN = 1e-6  # of the largest singular value


def unshifted(
    rows: Array, residuals: Array, sd: Array, mean: Array, height_m: float, beside: Array
) -> tuple[Array, Array, Array]:
    """Residuals (m,) after the best shift, one minus the leverage of each (m,), and what such a
    shift leaves of other residuals ``beside`` (m,).

    rows : (m, ROW_WIDTH), one per RSU and quantity; their biases are in the residuals
    residuals : (m,) at ``mean`` (n,); sd : (m,) of what is wrong with each

    Least squares by Gauss and Newton, with steps halved until they help. A linear projection would
    do near the truth only: two metres beside it an angle to an RSU three metres away has turned by
    a third, and what is left of it looks like an error of the RSU.
    """
    rows = rows.copy()
    rows[:, BIAS], rows[:, REFERENCE] = -1.0, 0.0
    shifted = [int(X.PX), int(X.PY), int(X.CLOCK)]
    height = int(rows[:, HEIGHT].max())
    if height > 0:  # one that is unknown may explain a residual, too
        shifted.append(height)
    innovation, H = linearise(rows, mean, height_m)
    rows[:, VALUE] += residuals - innovation
    place, left = mean.copy(), residuals / sd
    for _ in range(_STEPS):
        step = _step(H[:, shifted] / sd[:, None], left)
        if np.abs(H[:, shifted] @ step / sd).max() < _SMALL:
            break
        for halved in range(_HALVINGS):
            trial = place.copy()
            trial[shifted] += step / 2.0**halved
            innovation, trial_H = linearise(rows, trial, height_m)
            if innovation @ (innovation / sd**2) < left @ left:
                break
        else:
            break
        place, left, H = trial, innovation / sd, trial_H
    U = _seen(H[:, shifted] / sd[:, None])[0]
    left = left - U @ (U.T @ left)
    other = beside / sd
    other = other - U @ (U.T @ other)
    return left * sd, 1.0 - np.square(U).sum(axis=1), other * sd


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
