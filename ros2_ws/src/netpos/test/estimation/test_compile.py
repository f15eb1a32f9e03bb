"""Arrays on the stack of a kernel."""

from __future__ import annotations

import numpy as np
from netpos.estimation.compile import inlined, kernel, leaf, local_array
from netpos.messages.values import Array

_SIZE = 3


@inlined
def _reversed(n: int, x: Array, y: Array) -> None:
    for i in range(n):
        y[i] = x[n - 1 - i]


@leaf
def _work(out: Array) -> None:
    """Two vectors and a matrix side by side; whatever is written stays its own."""
    first, second, square = local_array(_SIZE), local_array(_SIZE), local_array(2, _SIZE)
    for i in range(_SIZE):
        first[i] = out[i]
        for k in range(2):
            square[k, i] = 10.0 * k + i
    _reversed(_SIZE, first, second)
    for i in range(_SIZE):
        out[i] = 100.0 * first[i] + second[i]
        out[_SIZE + i] = square[1, i] - square[0, i]
    out[2 * _SIZE] = first.size + second.size + square.shape[0] + square.shape[1]


@leaf
def _chosen(rows: Array, at: int) -> float:
    """An index the compiler cannot know."""
    x = local_array(2, _SIZE)
    for i in range(2):
        for j in range(_SIZE):
            x[i, j] = rows[i, j]
    total = 0.0
    for value in x[at]:
        total += value
    return total


@leaf
def _big(k: int) -> float:
    x = local_array(10_000)
    for i in range(10_000):
        x[i] = 1.0 if i == k else 0.0
    return float(x[k] + x[(k + 1) % 10_000])


@kernel
def _many(count: int) -> float:
    """The stack is given back: 80 kB each time."""
    total = 0.0
    for k in range(count):
        total += _big(k)
    return total


def test_local_arrays_do_not_share_memory() -> None:
    out = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0])
    _work(out)
    np.testing.assert_array_equal(out, [103.0, 202.0, 301.0, 10.0, 10.0, 10.0, 11.0])


def test_local_arrays_are_indexed_as_any() -> None:
    rows = np.arange(6.0).reshape(2, 3)
    assert [_chosen(rows, 0), _chosen(rows, 1), _chosen(rows, -1)] == [3.0, 12.0, 12.0]


def test_local_arrays_end_with_their_kernel() -> None:
    assert _many(1000) == 1000.0


def test_products_are_fused_and_nothing_else_is_relaxed() -> None:
    """Sums keep their order; what is not a number stays so."""

    @leaf
    def summed(x: Array) -> float:
        total = 0.0
        for value in x:
            total += value
        return total

    x = np.array([1e16, 1.0, -1e16, 1.0])
    assert summed(x) == 1.0
    assert summed(np.array([np.inf, 1.0])) == np.inf
    assert np.isnan(summed(np.array([np.inf, -np.inf])))
