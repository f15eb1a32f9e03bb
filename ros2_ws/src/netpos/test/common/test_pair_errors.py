"""Errors of pairs and of their receivers."""

from __future__ import annotations

import pytest
from netpos.common.pair_errors import of_each_receiver


def variances(pairs: dict[str, float]) -> dict[str, float]:
    found = of_each_receiver((name, variance, 1.0) for name, variance in pairs.items())
    return {name: variance for name, (variance, _) in found.items()}


def test_pairs_that_err_alike_are_of_receivers_that_do() -> None:
    assert variances({"ab": 2.0, "bc": 2.0, "cd": 2.0, "da": 2.0}) == dict.fromkeys("abcd", 1.0)
    assert variances({"ba": 2.0, "ca": 2.0, "da": 2.0}) == dict.fromkeys("abcd", 1.0)


@pytest.mark.parametrize("others", [1e-4, 0.1])
def test_one_receiver_that_errs_in_all_its_pairs_is_found(others: float) -> None:
    ring = {"ab": others, "bc": others, "cd": others, "de": 4.0, "ea": 4.0}
    star = {"ba": others, "ca": others, "da": others, "ea": 4.0}
    for pairs in (ring, star):
        found = variances(pairs)
        assert found.pop("e") == pytest.approx(4.0 - others / 2)
        assert all(variance == pytest.approx(others / 2) for variance in found.values())


def test_one_alone_keeps_its_own() -> None:
    assert of_each_receiver([("a", 0.3, 7.0)]) == {"a": (0.3, 7.0)}
