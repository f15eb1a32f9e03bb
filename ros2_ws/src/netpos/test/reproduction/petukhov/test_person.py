"""A person whose steps are off, round the rectangle with the anchor hidden."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.evaluation.work import Work
from netpos.reproduction.petukhov import person

SEEDS = range(5000, 5004)


def test_people_differ_by_10_to_15_percent_either_way() -> None:
    factors = np.array([person.person_of(seed).length_factor for seed in range(200)])
    off = np.abs(factors - 1.0)
    assert off.min() >= 0.10
    assert off.max() <= 0.15
    assert 0.4 < (factors > 1.0).mean() < 0.6


@pytest.fixture(scope="module")
def walks() -> dict[str, list[person.Walk]]:
    """Four people, with and without states for them."""
    variants = {"unknown": person.UNKNOWN, "estimated": person.ESTIMATED}
    return {name: [person.walk(seed, v) for seed in SEEDS] for name, v in variants.items()}


def test_the_bank_finds_factor_and_offset(walks: dict[str, list[person.Walk]]) -> None:
    """Within three sd, which ten steps bring down to a fifth of what people differ by."""
    for walk in walks["estimated"]:
        assert walk.sd[0] < 0.025
        assert walk.sd[1] < 0.025
        assert abs(walk.off[0]) < 3 * walk.sd[0]
        assert abs(walk.off[1]) < 3 * walk.sd[1]
    assert all(walk.sd == (0.0, 0.0) for walk in walks["unknown"])
    assert all(abs(walk.off[0]) > 0.08 for walk in walks["unknown"])


def test_fifteen_hidden_seconds(walks: dict[str, list[person.Walk]]) -> None:
    """The error is a third, and the covariance holds it."""
    rmse, nees = {}, {}
    for name, runs in walks.items():
        assert all(run.times_s[-1] > 24.8 for run in runs)  # hidden up to 25 s
        rmse[name], test = person.window(runs, 15.0, 25.0)
        nees[name] = test.mean
    assert rmse["estimated"] < rmse["unknown"] / 3
    assert nees["estimated"] < 3 < nees["unknown"]


def test_rows_are_named_once() -> None:
    with Work(runs=1, seed=5000, workers=1) as work:
        rows = list(person.rows(work))
    assert len({row.name for row in rows}) == len(rows) == 14
    judged = [row for row in rows if "NEES" in row.name and row.ok is not None]
    assert [row.name for row in judged] == [
        "steps 10 to 15 % off, heading 3 deg, estimated: NEES then, mean (expected 2)"
    ]
    assert judged[0].baseline is not None
    assert judged[0].defaults is not None
