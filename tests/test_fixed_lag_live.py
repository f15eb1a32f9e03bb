"""The smoothed topic of a running tracker is that of the same recording offline, and better."""

from __future__ import annotations

from pathlib import Path

import pytest
from netpos.evaluation.smoothing import smoothing_gains
from netpos.messages.topics import ODOMETRY_SMOOTHED, of_vue
from runs import (
    ODOMETRY,
    PATIENT,
    VUE,
    assert_same,
    changed_scenario,
    finish,
    graphs,
    messages,
    netpos,
    script,
    stamps,
)

LAG_S = 1.0
SMOOTHED = of_vue(VUE, ODOMETRY_SMOOTHED)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A short METIS, live at four times real time, and its live measurements tracked offline."""
    folder = tmp_path_factory.mktemp("fixed_lag")
    scenario = changed_scenario(
        folder / "lagging.yaml",
        "metis_madrid",
        tracker={**PATIENT, "fixed_lag_s": LAG_S},
        max_duration_s=20.0,
    )
    live, offline = folder / "live", folder / "offline"
    with graphs(folder) as (graph,):
        finish(script(graph, "run_graph", scenario, live, "4", "11"))
    netpos("replay", live, "--out", offline)
    return live, offline


def test_live_equals_offline(recordings: tuple[Path, Path]) -> None:
    assert_same(*recordings, (SMOOTHED, ODOMETRY), at_least=200)


def test_every_epoch_but_the_last_second_is_smoothed_once(recordings: tuple[Path, Path]) -> None:
    smoothed, all_stamps = (stamps(messages(recordings[0], t)) for t in (SMOOTHED, ODOMETRY))
    assert smoothed == [stamp for stamp in all_stamps if stamp <= smoothed[-1]]
    assert (all_stamps[-1] - smoothed[-1]) * 1e-9 == pytest.approx(LAG_S, abs=0.1)


def test_smoothed_is_nearer_to_the_truth(recordings: tuple[Path, Path]) -> None:
    gain = smoothing_gains(recordings[0])[VUE]
    assert gain.n > 150
    assert gain.ratio > 1.15
