"""Fusing two Gaussian estimates of one state whose errors may be correlated.

``independent``  P^-1 = A^-1 + B^-1: right only where the errors have nothing in common
``ci``           covariance intersection (Julier and Uhlmann 1997): right whatever they have in
                 common
``ici``          inverse covariance intersection (Noack, Sijs, Reinhardt and Hanebeck 2017): right
                 where what they have in common is an estimate both have fused
``split_ci``     split covariance intersection (Julier and Uhlmann 2001): only the part of each
                 covariance that is not the estimate's own may be correlated

The free weight w in (0, 1) minimises the determinant of the fused covariance: unlike a trace it
does not depend on the units of the state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from netpos.messages.values import Array

METHODS = ("independent", "ci", "ici", "split_ci")
_EDGE = 1e-6  # a weight of 0 would divide by it
_COARSE = 33
_FINE = 33


@dataclass(frozen=True, slots=True)
class Pair:
    """Fused estimate ``gain_a a + gain_b b``; the gains (n, n) add up to I.

    cov (n, n); own (n, n): the part of cov made of the own parts of a and b; weight: w.
    """

    gain_a: Array
    gain_b: Array
    cov: Array
    own: Array
    weight: float


def fuse_pair(cov_a: Array, own_a: Array, cov_b: Array, own_b: Array, method: str) -> Pair:
    """Gains and covariance of the fusion of two estimates of one state.

    cov_a, cov_b : (n, n) covariances, positive definite
    own_a, own_b : (n, n) the parts of them independent of everything the other has; 0: not known.
        Only ``split_ci`` looks at them.

    Raises ``ValueError`` for an unknown method and ``numpy.linalg.LinAlgError`` for a singular
    covariance.
    """
    if method not in METHODS:
        raise ValueError(f"fusion method must be one of {', '.join(METHODS)}, got {method!r}")
    gains_of = {"independent": _independent, "ci": _ci, "ici": _ici, "split_ci": _split_ci}[method]
    weight, gain_a, gain_b, cov = gains_of(cov_a, own_a, cov_b, own_b)
    own = gain_a @ own_a @ gain_a.T + gain_b @ own_b @ gain_b.T
    return Pair(gain_a, gain_b, _symmetric(cov), _symmetric(own), weight)


_Result = tuple[float, Array, Array, Array]


def _independent(cov_a: Array, own_a: Array, cov_b: Array, own_b: Array) -> _Result:
    info_a, info_b = _inv(cov_a), _inv(cov_b)
    cov = _inv(info_a + info_b)
    return 0.5, cov @ info_a, cov @ info_b, cov


def _ci(cov_a: Array, own_a: Array, cov_b: Array, own_b: Array) -> _Result:
    """P^-1 = w A^-1 + (1 - w) B^-1."""
    info_a, info_b = _inv(cov_a), _inv(cov_b)

    def information(w: Array) -> Array:
        return w * info_a + (1.0 - w) * info_b

    w = _best(lambda w: -_log_det(information(w)))
    cov = _inv(information(np.array(w)))
    return w, w * cov @ info_a, (1.0 - w) * cov @ info_b, cov


def _ici(cov_a: Array, own_a: Array, cov_b: Array, own_b: Array) -> _Result:
    """P^-1 = A^-1 + B^-1 - (w A + (1 - w) B)^-1."""
    info_a, info_b = _inv(cov_a), _inv(cov_b)

    def common(w: Array) -> Array:
        return _inv(w * cov_a + (1.0 - w) * cov_b)

    w = _best(lambda w: -_log_det(info_a + info_b - common(w)))
    shared = common(np.array(w))
    cov = _inv(info_a + info_b - shared)
    return w, cov @ (info_a - w * shared), cov @ (info_b - (1.0 - w) * shared), cov


def _split_ci(cov_a: Array, own_a: Array, cov_b: Array, own_b: Array) -> _Result:
    """P^-1 = (C_a / w + O_a)^-1 + (C_b / (1 - w) + O_b)^-1 with C = P - O."""
    shared_a, shared_b = cov_a - own_a, cov_b - own_b

    def parts(w: Array) -> tuple[Array, Array]:
        a = _inv(shared_a / w + own_a)
        return a, _inv(shared_b / (1.0 - w) + own_b)

    w = _best(lambda w: -_log_det(np.add(*parts(w))))
    info_a, info_b = parts(np.array(w))
    cov = _inv(info_a + info_b)
    return w, cov @ info_a, cov @ info_b, cov


def _best(cost: Callable[[Array], Array]) -> float:
    """Weight in (0, 1) of the smallest cost, to 1e-3: where it lies the cost is flat.

    cost takes weights (k, 1, 1) and gives (k,).
    """
    low, high = _EDGE, 1.0 - _EDGE
    for count in (_COARSE, _FINE):
        w = np.linspace(low, high, count)
        i = int(np.argmin(cost(w[:, None, None])))
        low, high = w[max(i - 1, 0)], w[min(i + 1, count - 1)]
    return float(w[i])


def _inv(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _log_det(matrix: Array) -> Array:
    """Logarithm of the determinant (k,) of each (k, n, n); -inf where it is not positive."""
    sign, value = np.linalg.slogdet(matrix)
    logarithm: Array = np.where(sign > 0, value, -np.inf)
    return logarithm


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2.0
