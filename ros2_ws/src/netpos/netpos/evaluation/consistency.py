"""Consistency of a filter: NEES, NIS and their bounds.

References: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, sec. 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import gammaincinv, stdtrit

from netpos.evaluation.correlated import mean_square_given_shape
from netpos.evaluation.pairing import Mask
from netpos.messages.values import Array

CONFIDENCE = 0.95


def whitened(error: Array, cov: Array) -> tuple[Array, Mask]:
    """Normalised errors ``L^-1 e`` with ``P = L L'``: of a consistent filter they have mean 0,
    variance 1 and no correlation between the columns.

    Parameters
    ----------
    error : (n, m) estimate minus truth
    cov : (n, m, m) covariance claimed by the filter

    Returns the (k, m) normalised errors of the epochs that have one, and the (n,) mask of those
    epochs: a covariance that is not positive definite (zero means unknown) or not finite gives
    none.
    """
    usable: Mask = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    usable[usable] = np.linalg.eigvalsh(cov[usable]).min(axis=1, initial=np.inf) > 0
    root = np.linalg.cholesky(cov[usable])
    return np.linalg.solve(root, error[usable][..., None])[..., 0], usable


def nees(error: Array, cov: Array) -> tuple[Array, Mask]:
    """Normalised estimation error squared ``e' P^-1 e`` of each epoch that has one, and the (n,)
    mask of those epochs; arguments as for ``whitened``.
    """
    errors, usable = whitened(error, cov)
    return np.einsum("ni,ni->n", errors, errors), usable


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanTest:
    """A mean of chi-square values against its two-sided 95 % bounds, which are as wide as those of
    ``n_eff`` independent values.
    """

    mean: float
    bounds: tuple[float, float]
    n_eff: float

    @property
    def consistent(self) -> bool:
        """The mean lies within the bounds, ends included."""
        return self.bounds[0] <= self.mean <= self.bounds[1]


def chi2_mean_bounds(dof: float, n: float, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Two-sided bounds of the mean of ``n`` independent chi-square values of ``dof`` degrees
    each; n need not be whole.
    """
    tail = (1.0 - confidence) / 2.0
    low, high = 2.0 * gammaincinv(dof * n / 2.0, [tail, 1.0 - tail]) / n  # chi-square quantiles
    return float(low), float(high)


def nees_test(errors: Array) -> MeanTest | None:
    """Test of the mean NEES of one run; None without epochs.

    Parameters
    ----------
    errors : (n, m) from ``whitened``, epochs in order of time and equally far apart

    Errors of neighbouring epochs share the filter's memory. The bounds hold the mean NEES of a
    consistent filter whose errors have this shape (``mean_square_given_shape``); a common factor
    of a column changes the mean, not the bounds. Columns count as independent. What is expected
    of any errors is never outside: a shape that says so is not one of those considered. The same
    errors give the same bounds, to the last bit. ``n_eff``: independent epochs with the same ratio
    of upper to lower bound.
    """
    n, dof = errors.shape
    if n == 0:
        return None
    rng = np.random.default_rng(0)
    draws = sum(mean_square_given_shape(column, rng) for column in errors.T)
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(draws, [tail, 1.0 - tail]).tolist()
    low, high = min(low, float(dof)), max(high, float(dof))
    mean = float(np.einsum("ni,ni->", errors, errors) / n)
    return MeanTest(mean=mean, bounds=(low, high), n_eff=_equivalent(dof, n, high / low))


def _equivalent(dof: int, n: int, ratio: float) -> float:
    """Number of independent values, in [0.1, n], whose bounds have this ratio."""

    def excess(log_n: float) -> float:
        low, high = chi2_mean_bounds(dof, float(np.exp(log_n)))
        return float(np.log(max(high, 1e-300) / max(low, 1e-300)) - np.log(ratio))

    ends = float(np.log(0.1)), float(np.log(n))
    if excess(ends[1]) >= 0.0:
        return float(n)
    return float(np.exp(brentq(excess, *ends))) if excess(ends[0]) > 0.0 else 0.1


def nis_test(values: Array, dof: Array) -> MeanTest | None:
    """Test of the mean NIS; ``dof`` may differ between epochs. None without values.

    Innovations of a consistent filter are white, so every epoch counts.
    """
    if values.size == 0:
        return None
    n = values.size
    return MeanTest(
        mean=float(values.mean()), bounds=chi2_mean_bounds(float(dof.mean()), n), n_eff=n
    )


def nees_over_runs(sums: Array, counts: Array, dof: int) -> MeanTest:
    """Test of the mean NEES of many runs by the spread between them.

    Parameters
    ----------
    sums : (R,) sum of the NEES of each run
    counts : (R,) estimates in each; runs without any count for nothing
    dof : degrees of freedom, the expected mean

    The bounds are those of Student's t around ``dof``, with the standard error of a ratio of means
    (Cochran, *Sampling Techniques*, 3rd ed., eq. 6.9): whatever correlation errors have within a
    run, runs are independent. One run alone counts as one chi-square value.

    Raises
    ------
    ValueError  no run has an estimate
    """
    kept = counts > 0
    sums, counts = sums[kept], counts[kept]
    runs = sums.size
    if runs == 0:
        raise ValueError("a test over runs needs a run with at least one estimate, got none")
    mean = float(sums.sum() / counts.sum())
    if runs == 1:
        return MeanTest(mean=mean, bounds=chi2_mean_bounds(dof, 1.0), n_eff=1.0)
    residuals = sums - mean * counts
    error = float(np.sqrt(runs / (runs - 1) * (residuals**2).sum()) / counts.sum())
    reach = float(stdtrit(runs - 1, (1.0 + CONFIDENCE) / 2.0)) * error
    n_eff = 2.0 * dof / error**2 if error > 0.0 else np.inf
    return MeanTest(mean=mean, bounds=(dof - reach, dof + reach), n_eff=float(n_eff))
