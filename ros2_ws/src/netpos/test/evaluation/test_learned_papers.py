"""What learning costs the papers: figures of several runs, and one short experiment."""

from __future__ import annotations

import math
from dataclasses import replace

import pandas as pd
import pytest
from netpos.evaluation.sweep import Plan, sweep
from netpos.evaluation.work import Work
from netpos.reproduction.fokin2020.paper import FIG_5_SLOW, METIS
from script_parts import loaded

COLUMNS = [
    *("n", "rmse_m", "max_m", "nees_mean"),
    *("availability", "unscored_s", "lost_tracks", "protection_exceeded"),
]


def test_runs_count_by_their_estimates_and_a_lost_one_by_what_it_lost() -> None:
    runs = pd.DataFrame(
        [
            (30, 1.0, 2.0, 3.0, 1.0, 0.5, 0, 0.0),
            (10, 3.0, 9.0, 1.0, 0.5, 1.0, 1, 0.2),
            (0, None, None, None, 0.0, 8.0, 1, None),
        ],
        columns=COLUMNS,
    )
    found = loaded("learned_papers").figures(runs)
    assert found == pytest.approx(
        {
            "rmse_m": math.sqrt((30.0 * 1.0 + 10.0 * 9.0) / 40.0),
            "max_m": 9.0,
            "nees_mean": 2.5,
            "availability": 0.5,
            "unscored_s": 9.5,
            "lost_tracks": 2.0,
            "protection_exceeded": 0.05,
        }
    )


def test_an_experiment_is_tracked_as_stated_and_with_learned_errors() -> None:
    """On the same seed; the figures as stated are those of a sweep that varies nothing."""
    short = replace(FIG_5_SLOW, changes=(*FIG_5_SLOW.changes, ("max_duration_s", 6.0)))
    with Work(1, 3, 1) as work:
        found = loaded("learned_papers").row("fokin2020", short, work)
        values = {key: (value,) for key, value in short.changes}
        stated = sweep(Plan(short.scenario, values), work).iloc[0]
    assert found["name"] == f"fokin2020: {short.name}"
    assert found["stated"]["rmse_m"] == pytest.approx(stated["rmse_m"])
    assert found["learned"]["rmse_m"] != pytest.approx(stated["rmse_m"], rel=1e-3)


def test_learning_costs_accuracy_not_the_track() -> None:
    """Where the variances are right: of a fast passage, 42 m/s and ten values a second, and of a
    street in Madrid with one a sixth of a second."""
    row = loaded("learned_papers").row
    with Work(4, 1, 1) as work:
        fast = row("fokin2020", FIG_5_SLOW, work)
        street = row("fokin2020", METIS[-1][0], work)
    assert fast["learned"]["rmse_m"] < 5.0 * fast["stated"]["rmse_m"]
    assert fast["learned"]["availability"] > 0.5 * fast["stated"]["availability"]
    assert street["learned"]["rmse_m"] < 2.0 * street["stated"]["rmse_m"]
    assert street["learned"]["availability"] > 0.99
    for case in (fast, street):
        assert case["learned"]["protection_exceeded"] == 0.0
        assert case["learned"]["lost_tracks"] == 0.0
