"""Robust weights and the mixture for late ranges: how far to trust a measurement that lies off.

**Weights.** ``huber_factor`` and ``student_t_factor`` give the factor on a group's variances that
makes an ordinary Kalman update the M-estimate of a heavy-tailed error.

**Late ranges.** A blocked path makes a range or a TOA late, never early. With a prior sd sqrt(A)
of the predicted range, A = H P H', noise variance R, S = A + R and innovation r,

    r = (prior error) + (noise) + e,    e = 0 with probability 1 - p, else an excess path > 0.

Given e, the update is Kalman's with r - e in place of r. So whatever the distribution of e, all
that the posterior takes from it is the posterior mean E and variance V of e: with K = P H' / S,

    mean = prior mean + K (r - E),    cov = P - K S K' + K V K'                             (M)

which is the moment-matched Gaussian sum; K V K' holds the spread of the means, as in probabilistic
data association (Bar-Shalom, Li and Kirubarajan 2001, sec. 1.4.16). In Joseph form: gain K of the
plain R, but K (R + V) K' as the noise term. (M) always holds; a scalar measurement that says the
same to an unaware update exists only for V < S (``equivalent_measurement``).
"""

from __future__ import annotations

import math

from netpos.estimation.compile import leaf

_LOG_2PI = math.log(2.0 * math.pi)
_TAIL = 40.0  # beyond this many sd the truncated normal is its asymptotic series
_NO_INFORMATION = 1e-3  # an equivalent measurement with less than this share of the information


@leaf
def huber_factor(d2: float, m: int, k: float) -> float:
    """Variance factor of Huber's (1964) estimate: 1 in the middle, linear influence beyond.

    d2 : squared Mahalanobis distance of a group with ``m`` degrees of freedom
    k : largest root-mean-square of the normalised innovations, sqrt(d2 / m), that keeps full
        weight; 1.345 costs 5 % efficiency for one Gaussian value
    """
    return max(1.0, math.sqrt(d2 / m) / k)


@leaf
def student_t_factor(d2: float, m: int, nu: float) -> float:
    """Variance factor of a Student-t error with ``nu`` degrees of freedom, as a scale mixture of
    Gaussians: 1 / E[weight | d2] = (nu + d2) / (nu + m).

    The variational update of Agamennoni, Nieto and Nebot (2012) when ``d2`` is that of the
    residual at the posterior and the update is repeated; the factor of Roth, Ozkan and Gustafsson
    (2013) when it is that of the innovation. Below 1 (not below nu / (nu + m)) where d2 < m: the
    variance is then the squared *scale* of the t, which has the variance nu / (nu - 2) of it.
    """
    return (nu + d2) / (nu + m)


@leaf
def _probability(log_odds: float) -> float:
    """Probability of log odds, without overflow."""
    if log_odds >= 0.0:
        return 1.0 / (1.0 + math.exp(-log_odds))
    odds = math.exp(log_odds)
    return odds / (1.0 + odds)


@leaf
def _log_odds(prior: float) -> float:
    if prior <= 0.0:
        return -math.inf
    return math.inf if prior >= 1.0 else math.log(prior / (1.0 - prior))


@leaf
def mixed_excess(probability: float, mean: float, variance: float) -> tuple[float, float, float]:
    """Probability, mean [m] and variance [m^2] of an excess that is 0 with probability 1 -
    ``probability``, else of ``mean`` [m], ``variance`` [m^2]."""
    spread = probability * (1.0 - probability) * mean * mean
    return probability, probability * mean, probability * variance + spread


@leaf
def _log_mills(z: float) -> float:
    """log(Phi(z) / phi(z)) of the standard normal."""
    if z < -_TAIL:
        return -math.log(-z) + math.log1p(-1.0 / (z * z) + 3.0 / z**4)
    if z > -5.0:
        return math.log(0.5 * math.erfc(-z / math.sqrt(2.0))) + 0.5 * (z * z + _LOG_2PI)
    x, tail = -z, 0.0
    for k in range(60, 0, -1):  # Laplace's continued fraction
        tail = k / (x + tail)
    return -math.log(x + tail)


@leaf
def positive_normal(z: float) -> tuple[float, float]:
    """Mean and variance of a normal variable of mean z and variance 1, given that it is > 0."""
    if z < -_TAIL:
        x2 = 1.0 / (z * z)
        return -(1.0 - 2.0 * x2 + 10.0 * x2 * x2) / z, x2 * (1.0 - 6.0 * x2 + 50.0 * x2 * x2)
    hazard = math.exp(-_log_mills(z))
    return z + hazard, 1.0 - hazard * (hazard + z)


@leaf
def exponential_excess(
    innovation: float, innovation_var: float, prior: float, mean_m: float
) -> tuple[float, float, float]:
    """Posterior of the excess path, exponential with ``mean_m`` where there is one: never early.

    innovation [m], innovation_var S = H P H' + R [m^2], prior probability of a blocked path.
    Returns the posterior probability of a blocked path, and E [m] and V [m^2] of (M).

    Given r, the excess is a normal variable of mean r - S / mean_m and variance S, cut off at 0,
    and the ratio of the likelihoods is sqrt(S) / mean_m times Phi(z) / phi(z) at
    z = r / sqrt(S) - sqrt(S) / mean_m: all exact.
    """
    sd = math.sqrt(innovation_var)
    z = innovation / sd - sd / mean_m
    probability = _probability(_log_odds(prior) + math.log(sd / mean_m) + _log_mills(z))
    mean, variance = positive_normal(z)
    return mixed_excess(  # type: ignore[no-any-return]
        probability, sd * mean, innovation_var * variance
    )


@leaf
def equivalent_measurement(
    innovation: float, innovation_var: float, measurement_var: float, mean: float, variance: float
) -> tuple[float, float]:
    """Shift and variance with which an ordinary update gives (M): ``value - shift``, R = variance.

    mean E [m] and variance V [m^2] of the excess. The covariances agree where 1 / S' = 1 / S -
    V / S^2, that is S' = S / (1 - V / S), and then the means where r - shift = (S' / S) (r - E).
    For V >= S no such measurement exists: the posterior is *wider* than the prior (two rival
    explanations). The variance returned is then inf and the shift r: leave the row out, which
    keeps the prior, or apply (M) itself, which is exact.
    """
    left = 1.0 - variance / innovation_var
    if left < _NO_INFORMATION:
        return innovation, math.inf
    shift = innovation - (innovation - mean) / left
    return shift, innovation_var / left - (innovation_var - measurement_var)


@leaf
def nlos_mixture_exponential(
    innovation: float,
    innovation_var: float,
    measurement_var: float,
    prior: float,
    mean_excess_m: float,
) -> tuple[float, float, float]:
    """Posterior probability of a blocked path, shift [m] and variance [m^2] of the equivalent
    measurement, for an exponential excess path; variance inf where none exists."""
    probability, mean, variance = exponential_excess(
        innovation, innovation_var, prior, mean_excess_m
    )
    shift, equivalent = equivalent_measurement(
        innovation, innovation_var, measurement_var, mean, variance
    )
    return probability, shift, equivalent


@leaf
def blocked_excess(
    innovation: float, innovation_var: float, mean_excess_m: float
) -> tuple[float, float, float]:
    """A late range taken for one of a blocked path: how much likelier it is than a direct one
    (log), E [m] and V [m^2] of (M)."""
    sd = math.sqrt(innovation_var)
    z = innovation / sd - sd / mean_excess_m
    mean, variance = positive_normal(z)
    likelier = math.log(sd / mean_excess_m) + _log_mills(z)
    return likelier, sd * mean, innovation_var * variance


@leaf
def matching_cost(
    blocked: float, mean: float, variance: float, innovation_var: float, measurement_var: float
) -> float:
    """What one Gaussian for both paths adds to the divergence, at most (Runnalls 2007, eq. 21).

    The path is ``blocked`` with this probability, with the excess ``mean`` [m], ``variance``
    [m^2].

    Along the gain K of the update both covariances differ from that of the direct path, and
    K' P^-1 K = A / (S R) with A = S - R.
    """
    known = (innovation_var - measurement_var) / (innovation_var * measurement_var)
    _, _, together = mixed_excess(blocked, mean, variance)
    return 0.5 * (math.log1p(known * together) - blocked * math.log1p(known * variance))


@leaf
def update_prior(
    alpha: float,
    beta: float,
    probability: float,
    forgetting: float,
    alpha0: float,
    beta0: float,
) -> tuple[float, float]:
    """Adaptive prior of one RSU: a beta distribution of the share of its measurements that are
    blocked, or outliers, alpha / (alpha + beta), after one that is so with ``probability``.

    ``forgetting`` in (0, 1]: the memory is 1 / (1 - forgetting) measurements, and what is
    forgotten goes back to (``alpha0``, ``beta0``) (stabilised forgetting, Kulhavy and Zarrop
    1993): the share never reaches 0 or 1, so no verdict is for ever.
    """
    fresh = 1.0 - forgetting
    return (
        forgetting * alpha + fresh * alpha0 + probability,
        forgetting * beta + fresh * beta0 + 1.0 - probability,
    )
