"""The noise streams against NumPy's Philox, and as random numbers."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.radio.noise import normals, philox, stream_key
from scipy import stats


def test_philox_equals_numpys() -> None:
    """NumPy counts up before it draws, so its first draw after counter c - 1 is that of c."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        key = rng.integers(0, 2**64, 2, dtype=np.uint64)
        counter = rng.integers(1, 2**64, 4, dtype=np.uint64)
        before = counter.copy()
        before[0] -= np.uint64(1)
        expected = np.random.Philox(counter=before, key=key).random_raw(4)
        np.testing.assert_array_equal(np.array(philox(*counter, *key), np.uint64), expected)


def test_philox_known_answer() -> None:
    """Test vector of the authors' library (philox4x64, 10 rounds, all ones)."""
    ones = np.uint64(2**64 - 1)
    drawn = philox(ones, ones, ones, ones, ones, ones)
    assert [int(word) for word in drawn] == [
        0x87B092C3013FE90B,
        0x438C3C67BE8D0224,
        0x9CC7D7C69CD777B6,
        0xA09CAEBF594F0BA0,
    ]


def test_normals_are_standard_and_independent() -> None:
    x = normals(np.arange(50_000), 6, stream_key(2, "test"))
    for column in x.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3
    correlation = np.corrcoef(x.T)
    assert np.abs(correlation - np.eye(6)).max() < 5 / np.sqrt(len(x))
    assert abs(np.corrcoef(x[:-1, 0], x[1:, 0])[0, 1]) < 5 / np.sqrt(len(x))


def test_a_draw_depends_on_seed_name_and_stamp_only() -> None:
    key = stream_key(7, "rsu_1/vue_1/noise")
    many = normals([10, 20, 30], 4, key)
    np.testing.assert_array_equal(normals([30], 4, key)[0], many[2])
    for other in (stream_key(8, "rsu_1/vue_1/noise"), stream_key(7, "rsu_2/vue_1/noise")):
        assert (normals([30], 4, other)[0] != many[2]).all()


def test_negative_seed_is_refused() -> None:
    with pytest.raises(ValueError, match="seed must be >= 0, got -1"):
        stream_key(-1, "x")
