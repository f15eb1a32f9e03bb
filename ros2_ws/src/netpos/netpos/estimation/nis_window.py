"""How much too small a covariance is, by the NIS of the last epochs."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from netpos.estimation.chi_square import chi_square_bound
from netpos.messages.values import Array

_WINDOWS = (3, 10, 25, 50)  # epochs
_CONFIDENCE = 0.999  # that the covariance stands, by all windows together


class NisWindow:
    """Factor on the sd from the NIS of the last epochs.

    While the sums over the last 3, 10, 25 and 50 epochs are below their chi-square bounds the
    covariance stands and the factor is 1. Where one is above, the covariance is called too small,
    and the factor is the largest sqrt(sum of NIS / sum of dof) of these windows, the scale factor
    of Birge (1932) as used by the Particle Data Group. A short window sees what has just begun, a
    long one what is small. The NIS of accepted groups is cut off by the gate: pass that of all
    groups, refused ones capped at the gate's threshold, or the factor sees nothing that matters.

    windows : epochs of each, increasing; ``confidence``: that none of them is exceeded by chance

    Raises ``ValueError`` for windows or a confidence that are none.
    """

    def __init__(self, windows: Sequence[int] = _WINDOWS, confidence: float = _CONFIDENCE) -> None:
        if not windows or windows[0] < 1 or sorted(set(windows)) != list(windows):
            raise ValueError(f"windows must be >= 1 and increase, got {windows!r}")
        if not 0.5 <= confidence < 1.0:
            raise ValueError(f"confidence must be in [0.5, 1), got {confidence}")
        self._windows = tuple(windows)
        self._tail = (1.0 - confidence) / len(windows)
        self._nis: deque[float] = deque(maxlen=windows[-1])
        self._dofs: deque[int] = deque(maxlen=windows[-1])

    def add(self, nis: float, dof: int) -> None:
        """Take the NIS of one epoch; one without measurements (``dof`` 0) says nothing."""
        if dof > 0:
            self._nis.append(nis)
            self._dofs.append(dof)

    def inflation(self) -> float:
        """Factor on the sd, >= 1."""
        factor2, all_nis, all_dofs = 1.0, list(self._nis), list(self._dofs)
        for epochs in self._windows:
            nis, dof = sum(all_nis[-epochs:]), sum(all_dofs[-epochs:])
            if nis > factor2 * dof and nis > chi_square_bound(dof, self._tail):
                factor2 = nis / dof
        return math.sqrt(factor2)

    @staticmethod
    def of_run(nis: Array, dof: Array) -> Array:
        """Factor on the sd (N,) after each of the epochs of a run, of their NIS (N,) and its
        degrees of freedom (N,)."""
        heard = dof > 0
        factor2 = np.ones(np.count_nonzero(heard))
        for epochs in _WINDOWS:
            sums = np.cumsum([nis[heard], dof[heard]], axis=1)
            sums[:, epochs:] = sums[:, epochs:] - sums[:, :-epochs]
            total, rows = sums[0], np.rint(sums[1]).astype(int)
            numbers, index = np.unique(rows, return_inverse=True)
            tail = (1.0 - _CONFIDENCE) / len(_WINDOWS)
            bounds = np.array([chi_square_bound(int(n), tail) for n in numbers])
            large = total > bounds[index]
            factor2[large] = np.maximum(factor2[large], total[large] / rows[large])
        return np.append(1.0, np.sqrt(factor2))[np.cumsum(heard)]

    def copy(self) -> NisWindow:
        """An independent copy: a track that goes back in time goes back to it."""
        twin = NisWindow.__new__(NisWindow)
        twin._windows, twin._tail = self._windows, self._tail
        twin._nis, twin._dofs = self._nis.copy(), self._dofs.copy()
        return twin
