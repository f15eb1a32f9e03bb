"""Paired differences against series whose difference is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.evaluation.compare import block_length, compare_bags, paired
from netpos.messages.values import Array

S = 1_000_000_000
DT_S = 0.1


def errors(rng: np.random.Generator, n: int, sd: float, tau_s: float) -> Array:
    """(n,) m: lengths of two-dimensional Gauss-Markov errors."""
    decay = math.exp(-DT_S / tau_s)
    offsets = np.empty((n, 2))
    offsets[0] = rng.normal(0.0, sd, 2)
    for k in range(1, n):
        offsets[k] = decay * offsets[k - 1] + sd * math.sqrt(1.0 - decay**2) * rng.normal(size=2)
    return np.asarray(np.linalg.norm(offsets, axis=1))


def stamps(n: int) -> Array:
    return np.arange(n) * round(DT_S * S)


@pytest.mark.parametrize("tau_s", [0.05, 2.0])
def test_the_interval_holds_the_true_difference_as_often_as_it_says(tau_s: float) -> None:
    """RMSE 1.41 and 1.27 m, errors that last 2 s."""
    true = math.sqrt(2.0) * (0.9 - 1.0)
    held = significant = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        pair = errors(rng, 3000, 1.0, tau_s), errors(rng, 3000, 0.9, tau_s)
        difference = paired(("a", "b"), "v", stamps(3000), pair)
        low, high = difference.interval_m
        assert low <= difference.difference_m <= high
        held += low <= true <= high
        significant += difference.told_apart
    assert held >= 52  # 57 expected
    if tau_s < 1.0:
        assert significant == 60


def test_the_same_on_both_sides_is_no_difference() -> None:
    same = errors(np.random.default_rng(1), 500, 1.0, 1.0)
    difference = paired(("a", "b"), "v", stamps(500), (same, same))
    assert difference.difference_m == 0.0
    assert difference.interval_m == (0.0, 0.0)
    assert not difference.told_apart
    assert "are not told apart" in difference.sentence()


def test_what_both_share_does_not_hide_a_difference() -> None:
    """Errors of 1 m that both have, and 5 % more on one side."""
    shared = errors(np.random.default_rng(2), 1000, 1.0, 3.0)
    difference = paired(("a", "b"), "v", stamps(1000), (shared, 1.05 * shared))
    assert difference.told_apart
    assert difference.sentence().startswith("v: b is worse than a by 0.0")
    assert difference.interval_m[0] > 0.02


def test_blocks_are_as_long_as_errors_last() -> None:
    rng = np.random.default_rng(3)
    white = block_length(rng.normal(size=5000), DT_S)
    slow = block_length(errors(rng, 5000, 1.0, 5.0) - 1.25, DT_S)
    assert white == 10  # a second
    assert 40 < slow <= 1000
    assert block_length(np.zeros(100), DT_S) == 10
    assert block_length(rng.normal(size=5), DT_S) == 1


def test_bags(tmp_path: Path, drive: Any, record: Callable[..., Path]) -> None:
    first, second = (record(tmp_path / name, drive) for name in ("one", "two"))
    (difference,) = compare_bags([first, second])
    assert (difference.vue, difference.first, difference.second) == ("vue_1", "one", "two")
    assert difference.difference_m == 0.0
    assert difference.epochs == 180
    assert (difference.only_first, difference.only_second) == (0, 0)
    assert difference.to_json()["told_apart"] is False


def test_bags_that_cannot_be_compared(tmp_path: Path, drive: Any, record: Any) -> None:
    bag = record(tmp_path / "one", drive)
    with pytest.raises(ValueError, match="two bags or more"):
        compare_bags([bag])
    other = record(tmp_path / "x" / "one", drive)
    with pytest.raises(ValueError, match="two bags have the same name"):
        compare_bags([bag, other])
    blind = record(tmp_path / "blind", drive, truth=False)
    with pytest.raises(ValueError, match="without ground truth"):
        compare_bags([bag, blind])
