"""Does the filter know how good it is: NEES, NIS, their bounds and the number of independent
epochs.

References: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, sec. 5.4; Geyer, *Practical Markov Chain Monte Carlo*, Statistical Science 7 (1992).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate
from scipy.stats import chi2

from netpos.evaluation.pairing import Mask
from netpos.messages.values import Array

CONFIDENCE = 0.95


def nees(error: Array, cov: Array) -> tuple[Array, Mask]:
    """Normalised estimation error squared ``e' P^-1 e`` of each epoch.

    Parameters
    ----------
    error : (n, m) estimate minus truth
    cov : (n, m, m) covariance claimed by the filter

    Returns the NEES of the epochs that have one, and the (n,) mask of those epochs: a covariance
    that is not positive definite (zero means unknown) or not finite gives none.
    """
    usable: Mask = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    usable[usable] = np.linalg.eigvalsh(cov[usable]).min(axis=1, initial=np.inf) > 0
    e, P = error[usable], cov[usable]
    return np.einsum("ni,ni->n", e, np.linalg.solve(P, e[..., None])[..., 0]), usable


def effective_size(series: Array) -> float:
    """Number of independent samples whose mean is as certain as the mean of this correlated
    series, in [1, n].

    n divided by the integrated autocorrelation time, summed over Geyer's initial monotone
    positive sequence, which needs no tuned lag. A constant series counts as one sample.

    Raises
    ------
    ValueError  the series is empty
    """
    n = series.size
    if n == 0:
        raise ValueError("effective_size needs at least one sample, got none")
    centred = series - series.mean()
    power = float(centred @ centred)
    if power <= 1e-24 * max(float(series @ series), 1.0):
        return 1.0
    rho = correlate(centred, centred, mode="full", method="fft")[n - 1 :] / power
    pairs = rho[: n - n % 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    positive = pairs[: ends[0]] if ends.size else pairs
    time = 2.0 * float(np.minimum.accumulate(positive).sum()) - 1.0
    return float(n / np.clip(time, 1.0, n))


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanTest:
    """A mean of chi-square values against its two-sided 95 % bounds; ``n_eff`` independent values
    stand behind it.
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
    low, high = chi2.ppf([tail, 1.0 - tail], dof * n) / n
    return float(low), float(high)


def nees_test(values: Array, dof: int) -> MeanTest | None:
    """Test of the mean NEES of one run; None without values.

    Errors of neighbouring epochs share the filter's memory, so the bounds are those of
    ``effective_size`` values, wider than those of n.
    """
    if values.size == 0:
        return None
    n_eff = effective_size(values)
    return MeanTest(mean=float(values.mean()), bounds=chi2_mean_bounds(dof, n_eff), n_eff=n_eff)


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
