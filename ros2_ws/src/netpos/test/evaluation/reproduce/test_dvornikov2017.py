"""The reproduction as a whole, on few seeds: rows, verdicts, pictures; swaps are noticed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from netpos.evaluation.reproduce import PAPERS
from netpos.evaluation.reproduce import dvornikov2017 as paper
from netpos.evaluation.reproduce.frame import Outcome, Work
from netpos.evaluation.reproduce.network_crossing import run_crossing
from netpos.evaluation.reproduce.network_summary import NetworkSummary


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    """Shorter runs of everything."""
    with Work(3, 5000, 1) as work:
        return paper.reproduce(work)


def test_it_is_known() -> None:
    assert PAPERS["dvornikov2017"] == paper.__name__


def test_rows_answer_the_targets(outcome: Outcome) -> None:
    rows = {row.name: row for row in outcome.rows}
    assert len(rows) == len(outcome.rows)
    limit = rows["paper's motion, gain floor, split_ci: RMSE of x at the 15th second"]
    assert (limit.paper, limit.ok) == (5.0, True)
    ratio = rows["paper's motion, gain floor: RMSE fused over the better network"]
    assert ratio.ours is not None
    assert 0.8 < ratio.ours < 1.1
    swaps = rows["5 objects crossing in all directions: runs without an identity swap"]
    assert (swaps.paper, swaps.ours) == (0.99, 1.0)
    assert not any("nan" in str(row.ours) for row in outcome.rows)


def test_pictures(outcome: Outcome, tmp_path: Path) -> None:
    paths = outcome.draw(tmp_path)
    assert {path.stem for path in paths} == {
        "fig6_gains",
        "fig7_errors",
        "tertiary",
        "gain_floor",
        "crossing",
    }
    assert all(path.stat().st_size > 10_000 for path in paths)


def test_forgetting_swaps_where_memory_does_not() -> None:
    """The count of swaps can rise: the same seeds, without memory."""
    kept, lost = (
        [run_crossing(entry.case, seed) for seed in range(5000, 5006)]
        for entry in paper.CROSSINGS[1:]
    )
    assert not any(run.swapped or run.renamed for run in kept)
    assert any(run.swapped for run in lost)
    assert all(run.fused_share > 0.5 for run in kept)


def test_figures_of_a_summary_by_hand() -> None:
    errors = np.array([[[3.0, 4.0], [0.0, 2.0]], [[0.0, 0.0], [6.0, 0.0]]])
    summary = NetworkSummary(
        setting=replace(paper.PAPER),
        time_s=np.array([0.0, 10.0]),
        errors={"a": errors},
        covs={"a": np.array([np.eye(2), 4.0 * np.eye(2)])},
    )
    assert summary.rmse_m("a") == pytest.approx(np.sqrt((25 + 4 + 0 + 36) / 4))
    assert summary.rmse_m("a", 5.0) == pytest.approx(np.sqrt(20.0))
    assert summary.rmse_m("a", 0.0, 10.0) == pytest.approx(np.sqrt(12.5))
    assert summary.axis_rmse_m("a", 5.0) == pytest.approx(np.sqrt(18.0))
    assert summary.axis_share_within("a", 5.0, 5.0) == 0.5
    assert summary.axis_largest_m("a", 5.0) == 6.0
    np.testing.assert_allclose(summary.nees("a"), [[25.0, 1.0], [0.0, 9.0]])
    test = summary.nees_test("a", 5.0)
    assert test.mean == 5.0
    assert test.n_eff == 2.0
