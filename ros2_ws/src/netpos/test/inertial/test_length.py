"""Step length: the published numbers, and the scale against least squares."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from netpos.inertial.length import LengthScale, frequency_length, weinberg_length


def test_frequency_model_by_hand() -> None:
    """The walker of the paper's mean cadence and 1.75 m; taller and faster people step longer."""
    assert frequency_length(1.79, 1.75) == pytest.approx(0.7)
    assert frequency_length(2.0, 1.75) == pytest.approx(0.7 + 0.227 * 0.21)
    assert frequency_length(1.5, 1.90) == pytest.approx(
        0.7 + 0.371 * 0.15 - 0.227 * 0.29 * 1.9 / 1.75
    )
    assert frequency_length(0.01, 1.0) == 0.2


def test_weinberg_scaling() -> None:
    assert weinberg_length(16.0, 0.5) == pytest.approx(1.0)
    assert weinberg_length(16.0 * 81, 0.5) == pytest.approx(3.0)
    assert weinberg_length(-1.0, 0.5) == 0.0


def test_scale_is_the_weighted_least_squares_with_its_prior() -> None:
    rng = np.random.default_rng(4)
    h, var = rng.uniform(-1, 6, 30), rng.uniform(0.01, 0.5, 30)
    z = 1.13 * h + rng.normal(scale=np.sqrt(var))
    scale = LengthScale(1.0, 0.1)
    for one in zip(h.tolist(), z.tolist(), var.tolist(), strict=True):
        scale.observe(*one)
    information = 1 / 0.1**2 + np.sum(h**2 / var)
    assert scale.var == pytest.approx(1 / information)
    assert scale.mean == pytest.approx((1 / 0.1**2 + np.sum(h * z / var)) / information)
    assert scale.sd == math.sqrt(scale.var)


def test_scale_from_ranges_of_one_anchor_is_consistent() -> None:
    """A walk round an anchor: the fall of the range over a step against its projection."""
    errors = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        truth = rng.normal(1.0, 0.1)
        scale = LengthScale(1.0, 0.1)
        angle = np.linspace(0, 2 * np.pi, 33)
        positions = np.column_stack([3 * np.cos(angle), 6 + 3 * np.sin(angle)])
        ranges = np.hypot(*positions.T)
        for a, b in itertools.pairwise(ranges.tolist()):
            modelled = (a - b) / truth
            measured = a - b + rng.normal(scale=0.03 * math.sqrt(2))
            scale.observe(modelled, measured, 2 * 0.03**2)
        errors.append((scale.mean - truth) / scale.sd)
    assert np.std(errors) == pytest.approx(1.0, abs=0.15)
    assert abs(np.mean(errors)) < 0.2


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        ((math.nan, 1.0, 1.0), "finite"),
        ((1.0, math.inf, 1.0), "finite"),
        ((1.0, 1.0, 0.0), "reference_var"),
        ((1.0, 1.0, math.nan), "reference_var"),
    ],
)
def test_bad_references_change_nothing(bad: tuple[float, float, float], word: str) -> None:
    scale = LengthScale(1.1, 0.2)
    with pytest.raises(ValueError, match=word):
        scale.observe(*bad)
    assert (scale.mean, scale.var) == (1.1, 0.2 * 0.2)
