"""The bound beside a recorded run: that of the simulation's own truth, or none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from netpos.evaluation.bounds import bound_rmse
from netpos.evaluation.evaluate import evaluate_bag
from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.recorded_bound import recorded_bound_m
from netpos.messages.values import Beacon, Odometry, RsuMeasurement
from netpos.reproduction.experiment import Experiment, Setup
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos.scenario.replay import replay_bag
from netpos.tracking.config import TrackerConfig

CHANGES = {"max_duration_s": 20.0}


@pytest.fixture(scope="module")
def run() -> dict[str, Any]:
    scenario = load_scenario("metis_madrid", changes=CHANGES)
    simulation = Simulation(scenario)
    truth, measured = [], []
    for event in simulation.events():
        if isinstance(event, Odometry):
            truth.append(event)
        elif isinstance(event, Beacon):
            measured += simulation.measure(event)
    return {
        "measurements": measured,
        "rsus": {info.rsu_id: info for info in simulation.rsus},
        "pose": simulation.initial_pose("vue_1"),
        "truth": Trajectory.of(truth),
        "config": TrackerConfig.from_mapping(dict(scenario.tracker)),
        "scored_ns": np.unique([m.stamp_ns for m in measured])[20:],
    }


def test_it_is_the_bound_of_the_simulation(run: dict[str, Any]) -> None:
    setup = Setup(Experiment(name="x", scenario="metis_madrid", changes=tuple(CHANGES.items())))
    track = setup.run(setup.simulation.scenario.seed)
    assert recorded_bound_m(**run) == pytest.approx(bound_rmse(track.bound[20:]), rel=1e-9)


def test_less_is_known_without_a_pose_and_with_fewer_measurements(run: dict[str, Any]) -> None:
    full = recorded_bound_m(**run)
    assert full is not None
    few: list[RsuMeasurement] = run["measurements"][::2]
    for change in ({"pose": None}, {"measurements": few}):
        bound = recorded_bound_m(**(run | change))
        assert bound is not None
        assert bound > full


def test_none_where_the_recording_does_not_tell(run: dict[str, Any]) -> None:
    biased = {k: replace(i, range_bias_sd_m=1.0) for k, i in run["rsus"].items()}
    for change in (
        {"rsus": biased},
        {"rsus": {}},
        {"measurements": run["measurements"][:2]},
        {"config": replace(run["config"], motion_model="constant_turn")},
        {"scored_ns": np.array([1], dtype=np.int64)},
    ):
        assert recorded_bound_m(**(run | change)) is None


def test_evaluate_reports_error_over_bound(run: dict[str, Any], tmp_path: Path) -> None:
    simulate_to_bag(load_scenario("metis_madrid", changes=CHANGES), tmp_path / "in")
    replay_bag(tmp_path / "in", tmp_path / "out")
    figures = evaluate_bag(tmp_path / "out").to_json()["vues"]["vue_1"]
    bound = recorded_bound_m(**run)
    assert bound is not None
    assert figures["bound_ratio"] == pytest.approx(figures["rmse_m"] / bound, rel=1e-6)
    assert 0.3 < figures["bound_ratio"] < 2.0
