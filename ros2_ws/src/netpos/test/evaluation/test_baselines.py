"""Every shipped scenario keeps the figures of its committed baseline."""

from __future__ import annotations

from pathlib import Path

import pytest
from netpos.evaluation.guard import figures_of, losses, read_baselines
from netpos.evaluation.guarded_runs import FEWEST_RUNS, RECORDINGS, SEEDS, cases
from netpos.scenario.load import scenario_names

BASELINES = read_baselines(Path(__file__).parents[5] / "tests" / "baselines")


def test_every_case_has_a_baseline_and_every_baseline_a_case() -> None:
    known = cases()
    assert known.keys() == {*scenario_names(), *RECORDINGS}
    assert BASELINES.keys() == known.keys(), "run `make baselines` and read the diff"
    for name, baseline in BASELINES.items():
        if name in RECORDINGS:
            assert baseline.runs == 1, name
        else:
            assert FEWEST_RUNS <= baseline.runs <= len(SEEDS), name


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", scenario_names())
def test_scenario_keeps_its_baseline(name: str) -> None:
    left = losses(name, BASELINES[name], figures_of(cases()[name]))
    assert not left, "\n".join(left)
