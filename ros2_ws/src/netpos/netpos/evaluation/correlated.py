"""Bounds of the mean square of correlated errors, from the shape of their series alone.

A consistent filter's normalised error is Gaussian with zero mean and variance 1; its
autocorrelation is unknown. We model it as a mixture of up to three exponentials,
``rho_k = sum_i w_i phi_i^k``. The discrete cosine transform makes such a series nearly
independent: coefficient j has variance S_j(phi, w). Given the shape of the series (the series up
to a factor) and the autocorrelation, the mean square is chi-square distributed; we average over
the posterior of the autocorrelation, which depends on the shape only. The factor itself, which
tells whether the filter is consistent, does not enter.

References: Whittle, *Estimation and information in stationary time series*, Arkiv foer Matematik 2
(1953); Ahmed, Natarajan, Rao, *Discrete Cosine Transform*, IEEE Trans. Computers C-23 (1974).
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.fft import dct

from netpos.messages.values import Array

Ints = npt.NDArray[np.int64]

DRAWS = 4000
BAND_RATIO = 1.25  # upper over lower edge of a band of coefficients
COUNTED = 2000  # coefficients that count at most, see _counted
STEP = 1.25  # between neighbouring correlation times
LONG, LONG_STEP = 4.0, 4.0  # correlation times above LONG series lengths are LONG_STEP apart
LONGEST, SMOOTHEST = 1e4, 300.0  # correlation times in series lengths
TAIL = 0.25  # prior density of atanh(phi) ~ (1 - phi^2)^TAIL
NEGATIVE = (-0.6, -0.25)
ONE, TWO, THREE = 0.8, 0.17, 0.03  # prior of the number of exponentials
PAIR_WEIGHTS = np.sin(np.pi / 2 * (np.arange(10) + 0.5) / 10) ** 2
TRIPLE_WEIGHTS = (0.08, 0.2, 0.35, 0.5, 0.65, 0.8)
COARSE = 3  # triples take every third correlation time


def cosine_variances(n: int, phi: float) -> Array:
    """Variances (n,) of the cosine transform (type II, orthonormal) of n values with
    autocorrelation ``phi^k`` and variance 1; exact.

    The inverse of their covariance is diagonal under the transform but for its two corners, which
    Woodbury's formula adds.
    """
    if phi == 0.0:
        return np.ones(n)
    square_of_sine, corner = _half_angles(n)
    diagonal = (1.0 - phi) ** 2 + 4.0 * phi * square_of_sine
    variances = 1.0 / diagonal
    for start in (0, 1):  # even and odd coefficients do not mix
        ratio = corner[start::2] / diagonal[start::2]
        common = 1.0 / (phi * (1.0 - phi)) + float(ratio @ corner[start::2])
        variances[start::2] -= ratio**2 / common
    return np.asarray((1.0 - phi**2) * variances)


@lru_cache(maxsize=1)
def _half_angles(n: int) -> tuple[Array, Array]:
    """Squared sines (n,) of half the frequencies, and the transform (n,) of the two ends."""
    half = np.pi / 2 * np.arange(n) / n
    corner = np.cos(half) * 2.0 / np.sqrt(n)
    corner[0] = np.sqrt(2.0 / n)
    return np.sin(half) ** 2, corner


class _Family(NamedTuple):
    """All autocorrelations considered for n values, in B bands of coefficients.

    first (B,) index of each band's first coefficient; size, counted (B,) coefficients in it and
    those that count; inverse (H, B) one over the mean variance in each band under each of H
    autocorrelations; log_prior (H,) with the determinant of the likelihood; smoothest (B,) least
    power of a band over that of the first: a smoother series has no more information.
    """

    first: Ints
    size: Array
    counted: Array
    inverse: Array
    log_prior: Array
    smoothest: Array


def _band_edges(n: int) -> Ints:
    edges = [0]
    while edges[-1] < n:
        edges.append(max(edges[-1] + 1, int(np.ceil(edges[-1] * BAND_RATIO))))
    edges[-1] = n
    if len(edges) > 3 and edges[-1] - edges[-2] < 0.4 * (edges[-2] - edges[-3]):
        del edges[-2]
    return np.array(edges, dtype=np.int64)


def _counted(size: Array) -> Array:
    """Coefficients that count of each band: a common cap, such that at most ``COUNTED`` do.

    Three exponentials only resemble a true autocorrelation: without the cap the many high
    frequencies of a long series would outvote the few low ones, which decide the bounds.
    """
    low, high = 1.0, float(size.max())
    if size.sum() <= COUNTED:
        return size
    while high - low > 0.5:
        middle = (low + high) / 2
        low, high = (low, middle) if np.minimum(size, middle).sum() > COUNTED else (middle, high)
    return np.asarray(np.minimum(size, low))


def _exponentials(n: int) -> Array:
    """Values of phi, ascending: negative, none, and positive ones by correlation time."""
    times = [0.6]
    while times[-1] < LONGEST * n:
        times.append(times[-1] * (STEP if times[-1] < LONG * n else LONG_STEP))
    return np.array([*NEGATIVE, 0.0, *np.exp(-1.0 / np.array(times))])


@lru_cache(maxsize=4)
def _family(n: int) -> _Family:
    edges = _band_edges(n)
    first, size = edges[:-1], np.diff(edges).astype(np.float64)

    def banded(phi: float) -> Array:
        return np.asarray(np.add.reduceat(cosine_variances(n, phi), first) / size)

    phi = _exponentials(n)
    single = np.array([banded(p) for p in phi.tolist()])
    prior = np.gradient(np.arctanh(phi)) * (1.0 - phi**2) ** TAIL
    prior /= prior.sum()
    few = np.append(np.arange(3), np.arange(3, phi.size, COARSE))
    variances, priors = [single], [ONE * prior]
    i, j = np.array(list(combinations(range(phi.size), 2))).T
    both = prior[i] * prior[j]
    for w in PAIR_WEIGHTS:
        variances.append(w * single[i] + (1.0 - w) * single[j])
        priors.append(TWO * both / both.sum() / PAIR_WEIGHTS.size)
    i, j, k = few[np.array(list(combinations(range(few.size), 3)))].T
    three = prior[i] * prior[j] * prior[k]
    weights = [(a, b) for a in TRIPLE_WEIGHTS for b in TRIPLE_WEIGHTS if a + b < 0.98]
    for a, b in weights:
        variances.append(a * single[i] + b * single[j] + (1.0 - a - b) * single[k])
        priors.append(THREE * three / three.sum() / len(weights))
    every, counted = np.concatenate(variances), _counted(size)
    log_prior = np.log(np.concatenate(priors)) - 0.5 * np.log(every) @ counted
    smoothest = banded(np.exp(-1.0 / (SMOOTHEST * n)))
    smoothest[0] = 0.0
    smoothest /= n
    return _Family(first, size, counted, 1.0 / every, log_prior, smoothest)


def mean_square_given_shape(series: Array, rng: np.random.Generator) -> Array:
    """Draws (``DRAWS``,) of the mean square that a Gaussian series of variance 1 has, given that
    it is proportional to this ``series`` (n,); in random order.

    A series of zeros has no shape; its mean square is that of one value.
    """
    n = series.size
    power = float(series @ series) / n
    if power == 0.0:
        return rng.chisquare(1.0, DRAWS)
    family = _family(n)
    squares = dct(series / np.sqrt(power), norm="ortho") ** 2
    bands = np.add.reduceat(squares, family.first) / family.size
    shape_cost = family.inverse @ (family.counted * np.maximum(bands, bands[0] * family.smoothest))
    total = float(family.counted.sum())
    log_posterior = family.log_prior - 0.5 * total * np.log(shape_cost)
    cumulated = np.cumsum(np.exp(log_posterior - log_posterior.max()))
    quantiles = (np.arange(DRAWS) + 0.5) / DRAWS * cumulated[-1]
    chosen = rng.permutation(np.searchsorted(cumulated, quantiles))
    return np.asarray(rng.chisquare(total, DRAWS) / shape_cost[chosen])
