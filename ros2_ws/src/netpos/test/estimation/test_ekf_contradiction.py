"""Groups that pass the gate one by one but contradict each other."""

from __future__ import annotations

import numpy as np
import pytest
from ekf_update import updated
from filter_rows import linear_row
from netpos.estimation.measurement import (
    GROUP,
    ORIGIN,
    VALUE,
)
from netpos.messages.values import Array
from scipy.stats import chi2


def renumbered(rows: Array) -> Array:
    rows = rows.copy()
    rows[:, GROUP] = np.unique(rows[:, GROUP], return_inverse=True)[1]
    return rows


def contradiction(groups: int, off: float) -> tuple[Array, Array, Array]:
    """Groups of one row each that share an unknown offset; the second is ``off`` beside it."""
    mean, cov = np.zeros(6), np.diag([1.0, 1.0, 1.0, 1.0, 1e8, 1.0])
    h = np.eye(6)[4]
    rows = [linear_row(h, 500.0 + (off if g == 1 else 0.1 * g), 1.0, g) for g in range(groups)]
    return mean, cov, np.array(rows)


@pytest.mark.parametrize("iterations", [1, 8])
def test_one_that_contradicts_the_others_jointly_is_left_out(iterations: int) -> None:
    """Each passes alone, the offset being unknown; together one of four is off."""
    gate = np.append(0.0, chi2.ppf(0.9999, np.arange(1, 13)))
    mean, cov, rows = contradiction(4, 30.0)
    for g in range(4):
        alone = rows[[g]]
        alone[:, GROUP] = 0
        assert updated(mean, cov, alone, 0.0, gate, iterations)[2].tolist() == [1.0]
    x, P, accepted, nis, used = updated(mean, cov, rows, 0.0, gate, iterations)
    assert accepted.tolist() == [1.0, 0.0, 1.0, 1.0]
    assert used == 3
    kept = renumbered(rows[[0, 2, 3]])
    expected = updated(mean, cov, kept, 0.0, gate, iterations)
    np.testing.assert_array_equal(x, expected[0])
    np.testing.assert_array_equal(P, expected[1])
    assert nis == expected[3]


def test_a_contradiction_without_an_odd_one_out_changes_nothing() -> None:
    """Of two nobody knows which is wrong; of two against two neither."""
    gate = np.append(0.0, chi2.ppf(0.9999, np.arange(1, 13)))
    mean, cov, rows = contradiction(2, 30.0)
    assert updated(mean, cov, rows, 0.0, gate, 1)[2].tolist() == [1.0, 1.0]
    mean, cov, rows = contradiction(4, 30.0)
    rows[3, VALUE] += 30.0 * np.linalg.norm(rows[3, ORIGIN : ORIGIN + 6])
    result = updated(mean, cov, rows, 0.0, gate, 1)
    assert result[2].tolist() == [1.0, 1.0, 1.0, 1.0]
    # and just within the joint limit nothing is contradicted
    mean, cov, rows = contradiction(3, 0.3)
    assert updated(mean, cov, rows, 0.0, gate, 1)[2].tolist() == [1.0, 1.0, 1.0]
