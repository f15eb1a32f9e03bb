"""What the benchmark compares computes the same: our kernels, FilterPy and the C yardstick."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from netpos.bench import filters, stone_soup, yardstick
from netpos.bench.common import LeftOut, Row, Unavailable
from netpos.bench.problem import DT_S, HEIGHT_M, ROWS, Problem, model, problem
from netpos.bench.yardstick import Yardstick
from netpos.estimation.state import POSITION
from netpos.messages.values import Array

EPOCHS = 200
needs_compiler = pytest.mark.skipif(
    shutil.which("cc") is None, reason="no C compiler (cc) on PATH"
)


@pytest.fixture(scope="module")
def walk() -> Problem:
    return problem(EPOCHS)


@pytest.fixture(scope="module")
def posterior(walk: Problem) -> tuple[Array, Array]:
    """FilterPy with h and H written in NumPy: nothing of ours but R."""
    return filters.FilterPyEkf(walk, compiled=False).run()


def same(ours: tuple[Array, Array], theirs: tuple[Array, Array]) -> None:
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    "run", [filters.compiled_ekf, filters.called_ekf], ids=["compiled", "called"]
)
def test_ekf_equals_filterpy(
    run: Callable[[Problem], tuple[Array, Array]],
    walk: Problem,
    posterior: tuple[Array, Array],
) -> None:
    same(run(walk), posterior)


def test_filterpy_with_our_models_is_the_same_filter(
    walk: Problem, posterior: tuple[Array, Array]
) -> None:
    same(filters.FilterPyEkf(walk).run(), posterior)


@needs_compiler
def test_yardstick_equals_filterpy(
    walk: Problem, posterior: tuple[Array, Array], tmp_path: Path
) -> None:
    same(Yardstick(tmp_path).run(walk), posterior)


@pytest.mark.parametrize(
    "run", [filters.compiled_srukf, filters.called_srukf], ids=["compiled", "called"]
)
def test_srukf_equals_filterpy(
    run: Callable[[Problem], tuple[Array, Array]], walk: Problem
) -> None:
    same(run(walk), filters.FilterPyUkf(walk).run())


def test_a_run_does_not_use_up_its_problem() -> None:
    walk, untouched = problem(3), problem(3)
    first = filters.compiled_ekf(walk)
    same(filters.compiled_ekf(walk), first)
    for name in ("mean", "cov", "rows"):
        np.testing.assert_array_equal(getattr(walk, name), getattr(untouched, name))


def test_the_filter_follows_the_walk(walk: Problem) -> None:
    """The measurements are of the walk: 1 m/s east from 40 m, so 20 m on after 200 epochs."""
    mean, cov = filters.compiled_ekf(walk)
    error = mean[POSITION] - [60.0, 0.0]
    assert (
        error @ np.linalg.solve(cov[POSITION, POSITION], error) < 13.8
    )  # chi-square 0.999, 2 dof
    assert np.sqrt(np.trace(cov[POSITION, POSITION])) < 2.0


def test_the_numpy_jacobian_is_the_derivative(walk: Problem) -> None:
    x, rows, step = walk.mean, walk.rows[0], 1e-5
    numeric = np.empty((ROWS, 6))
    for j in range(6):
        e = step * np.eye(6)[j]
        high, low = filters.numpy_expected(x + e, rows), filters.numpy_expected(x - e, rows)
        numeric[:, j] = (high - low) / (2.0 * step)
    np.testing.assert_allclose(filters.numpy_jacobian(x, rows), numeric, atol=1e-8)


def test_the_model_is_constant_velocity_with_a_two_state_clock() -> None:
    F, Q = model()
    expected = np.eye(6)
    expected[[0, 1, 4], [2, 3, 5]] = DT_S
    np.testing.assert_array_equal(F, expected)
    assert HEIGHT_M == 0.0  # the compiled loops say so too
    assert (np.linalg.eigvalsh(Q) > 0.0).all()


def test_without_a_compiler_the_row_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    rows = filters.ekf_rows(quick=True)
    assert [row.relation for row in rows if isinstance(row, Row)] == [">="] * 4
    (left_out,) = [row for row in rows if isinstance(row, LeftOut)]
    assert "no-such-compiler is not on PATH" in left_out.reason


@needs_compiler
def test_ekf_rows_have_the_targets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    rows = [row for row in filters.ekf_rows(quick=True) if isinstance(row, Row)]
    assert [(row.relation, row.target) for row in rows] == [
        *[(">=", 60), (">=", 20)] * 2,
        ("<=", 1.5),
    ]
    assert rows[0].ratio == pytest.approx(rows[0].reference_value / rows[0].ours)
    assert rows[4].ratio == pytest.approx(rows[4].ours / rows[4].reference_value)
    assert rows[0].ours == rows[2].ours == rows[4].ours


def test_srukf_rows_have_the_targets() -> None:
    rows = [row for row in filters.srukf_rows(quick=True) if isinstance(row, Row)]
    assert [(row.relation, row.target) for row in rows] == [(">=", 20.0), (">=", 20.0)]


def test_a_compiler_that_fails_is_a_reason(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    broken = tmp_path / "broken"
    broken.write_text("#!/bin/sh\necho 'out of paper' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    with pytest.raises(Unavailable, match="out of paper"):
        Yardstick(tmp_path)
    assert yardstick.compiler() == str(broken)


def test_stone_soup_is_left_out_where_it_is_not_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def absent(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(stone_soup, "import_module", absent)
    (left_out,) = stone_soup.stone_soup_rows(quick=True)
    assert isinstance(left_out, LeftOut)
    assert "not installed" in left_out.reason


def test_stone_soup_equals_ours() -> None:
    pytest.importorskip("stonesoup", reason="Stone Soup is not installed")
    walk = problem(20)
    same(filters.called_ekf(walk), stone_soup.StoneSoupEkf(walk).run())
