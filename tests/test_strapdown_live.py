"""The drive in space as a live graph: three-dimensional measurements, IMU, strapdown tracker."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from netpos.bags import codec
from runs import (
    INFOS,
    MEASUREMENTS,
    ODOMETRY,
    PATIENT,
    TRACK_STATUS,
    TRUTH,
    assert_same,
    changed_scenario,
    finish,
    graphs,
    messages,
    netpos,
    payloads,
    script,
)

SEED = "3"


def test_odometry_between_epochs_and_the_clock_are_the_same_live_and_offline(
    tmp_path: Path,
) -> None:
    """One-way times and 50 Hz of odometry, bit by bit, and what the epochs say is not changed."""
    drive = changed_scenario(
        tmp_path / "drive.yaml",
        "blocked_5g_drive",
        max_duration_s=30.0,
        measurement={
            "quantities": ["azimuth", "elevation", "toa"],
            "nearest": 5,
            "fewest": 4,
            "errors": {
                "model": "fixed",
                "azimuth_sd_deg": 8.5,
                "elevation_sd_deg": 2.5,
                "toa_sd_s": 3.336e-9,
            },
        },
        tracker={**PATIENT, "odometry_rate_hz": 50.0},
    )
    live, offline = tmp_path / "live", tmp_path / "offline"
    with graphs(tmp_path) as (graph,):
        started = script(graph, "run_graph", drive, live, "3", SEED)
        netpos("run", drive, "--offline", "--seed", SEED, "--bag", offline)
        finish(started)
    topics = (ODOMETRY, TRACK_STATUS, "/vue_1/clock_state")
    assert_same(live, offline, topics, at_least=1000)
    again, sparse = tmp_path / "again", tmp_path / "sparse"
    netpos("replay", live, "--out", again)
    assert_same(again, live, topics)
    netpos("replay", live, "--out", sparse, "--set", "odometry_rate_hz=0", "--smooth")
    at_epochs = payloads(sparse, (ODOMETRY,))[ODOMETRY]
    assert len(at_epochs) < 30
    assert set(at_epochs) <= set(payloads(live, (ODOMETRY,))[ODOMETRY])
    assert len(messages(sparse, "/vue_1/odometry_smoothed")) == len(at_epochs)


def test_a_drive_in_space_is_the_same_live_and_offline(tmp_path: Path) -> None:
    """Every message alike, bit by bit; position, height and attitude are those of the truth."""
    drive = changed_scenario(
        tmp_path / "drive.yaml", "blocked_5g_drive", tracker=PATIENT, max_duration_s=40.0
    )
    live, offline = tmp_path / "live", tmp_path / "offline"
    with graphs(tmp_path) as (graph,):
        started = script(graph, "run_graph", drive, live, "4", SEED)
        netpos("run", drive, "--offline", "--seed", SEED, "--bag", offline)
        finish(started)
    topics = (INFOS, MEASUREMENTS, ODOMETRY, TRACK_STATUS, TRUTH, "/vue_1/imu", "/vue_1/beacon")
    assert_same(live, offline, topics)
    again = tmp_path / "again"
    netpos("replay", live, "--out", again)
    assert_same(again, live, (ODOMETRY,))
    truth = {o.stamp_ns: o for o in map(codec().odometry_from_msg, messages(live, TRUTH))}
    found = [codec().odometry_from_msg(m) for m in messages(live, ODOMETRY)]
    assert len(found) >= 20
    errors = np.array([o.position - truth[o.stamp_ns].position for o in found[-10:]])
    assert np.linalg.norm(errors[:, :2], axis=1).max() < 5.0
    assert np.abs(errors[:, 2]).max() < 3.0
    facing = [abs(o.quaternion @ truth[o.stamp_ns].quaternion) for o in found[-10:]]
    assert min(facing) > np.cos(0.1)  # half of 0.2 rad
