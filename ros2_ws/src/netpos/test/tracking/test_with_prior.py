"""Another prior of a state against filters that had it from the start."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation.mixture.gaussians import Mixture
from netpos.messages.values import Array
from netpos.tracking.estimators.estimates import with_prior
from scipy.stats import multivariate_normal

BEFORE = 0.4
MEANS = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]])
SHAPE = np.array([[1.0, 0.3], [0.3, 2.0]])
H = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.6, 0.8, 1.0], [1.0, 0.0, 0.0]])
VALUES = np.array([1.4, 0.9, 1.5, 0.6])


def posterior(bias_sd: float) -> Mixture:
    """Two components after four values of two places, of which three have a bias of that sd."""
    cov = np.zeros((3, 3))
    cov[:2, :2], cov[2, 2] = SHAPE, bias_sd**2
    S = H @ cov @ H.T + 0.09 * np.eye(4)
    K = cov @ H.T @ np.linalg.inv(S)
    means = np.array([m + K @ (VALUES - H @ m) for m in MEANS])
    weights = np.array([multivariate_normal(H @ m, S).logpdf(VALUES) for m in MEANS])
    weights -= np.logaddexp.reduce(weights)
    return Mixture(means, np.array([cov - K @ S @ K.T] * 2), weights)


@pytest.mark.parametrize("after", [0.05, 0.2, 0.39])
def test_narrower_it_is_as_if_the_prior_had_been_that_from_the_start(after: float) -> None:
    found, expected = with_prior(posterior(BEFORE), 2, BEFORE, after), posterior(after)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("after", [0.41, 1.0, 30.0])
def test_wider_the_state_has_the_variance_it_would_have_had(after: float) -> None:
    """And nothing else has changed."""
    before = posterior(BEFORE)
    found, expected = with_prior(before, 2, BEFORE, after), posterior(after)
    np.testing.assert_allclose(found.covs[:, 2, 2], expected.covs[:, 2, 2], rtol=1e-7)
    np.testing.assert_array_equal(found.means, before.means)
    np.testing.assert_allclose(found.log_weights, before.log_weights, rtol=1e-12)
    rest = found.covs.copy()
    rest[:, 2, 2] = before.covs[:, 2, 2]
    np.testing.assert_array_equal(rest, before.covs)


@pytest.mark.parametrize("after", [0.1, 0.5, 4.0])
def test_state_known_no_better_than_its_prior_keeps_its_share(after: float) -> None:
    """What linearising left out may have widened it beyond; it stays a covariance."""
    wide: Array = np.array([[[1.0, 0.2, 0.1], [0.2, 1.0, 0.0], [0.1, 0.0, 2.0 * BEFORE**2]]])
    found = with_prior(Mixture(np.zeros((1, 3)), wide, np.zeros(1)), 2, BEFORE, after)
    assert np.linalg.eigvalsh(found.covs[0])[0] > 0.0
    assert found.covs[0, 2, 2] == pytest.approx(2.0 * after**2)
