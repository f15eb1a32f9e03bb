"""Chi-square bounds against SciPy."""

from __future__ import annotations

import math

import pytest
from netpos.estimation.chi_square import chi_square_bound
from scipy.stats import chi2


@pytest.mark.parametrize("dof", [1, 2, 3, 4, 5, 6, 7, 8, 15, 16, 64, 101, 200, 501, 3000])
@pytest.mark.parametrize("tail", [1e-15, 1e-9, 1e-4, 1e-3, 0.01, 0.05, 0.3, 0.5, 0.9, 0.99])
def test_bound(dof: int, tail: float) -> None:
    assert chi_square_bound(dof, tail) == pytest.approx(chi2.isf(tail, dof), rel=1e-11)


@pytest.mark.parametrize("dof", [1, 2, 3, 10, 99])
def test_bounds_nearly_all_exceed(dof: int) -> None:
    """As exact as a probability near 1 tells its distance from 1."""
    bound = chi_square_bound(dof, 1.0 - 1e-9)
    assert chi2.cdf(bound, dof) == pytest.approx(1e-9, rel=1e-5)


def test_the_ends() -> None:
    assert chi_square_bound(3, 0.0) == math.inf
    assert chi_square_bound(3, 1.0) == 0.0


@pytest.mark.parametrize(
    ("dof", "tail"), [(0, 0.1), (-1, 0.1), (2, -0.1), (2, 1.1), (2, math.nan)]
)
def test_what_has_no_bound(dof: int, tail: float) -> None:
    with pytest.raises(ValueError, match="dof" if dof < 1 else "tail"):
        chi_square_bound(dof, tail)
