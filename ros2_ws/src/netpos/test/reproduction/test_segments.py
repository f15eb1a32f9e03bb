"""A run goes on past the loss of its track, as its tracker does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from netpos.estimation.state import POSITION
from netpos.reproduction.experiment import FACTS, Experiment, Setup
from netpos.tracking import TrackerConfig
from setup_tracker import tracker_outputs

LOSING = Experiment(
    name="one RSU",
    scenario="metis_madrid_strong_signal",
    changes=(("measurement.nearest", 1), ("devices.0.beacon_interval_s", 100 * 167.3e-6)),
    estimator="defaults",
)


RIGID = (
    ("accel_density_mps2_sqrthz", 1.0),
    ("manoeuvre_speed_sd_mps", 0.0),
    ("clock_walk_density", 2.5e-7),
)
"""Settings that lose the device in a turn."""


def _of_the_tracker(setup: Setup, seed: int) -> dict[int, tuple[np.ndarray, float] | None]:
    """Position and protection level by stamp; None where the tracker has no track."""
    return {
        o.status.stamp_ns: (o.odometry.position[:2], o.status.protection_level_m)
        if o.odometry
        else None
        for o in tracker_outputs(setup, seed)
    }


@pytest.mark.timeout(900)  # hundreds of attempts at a first fix
@pytest.mark.parametrize("seed", [7, 8])
def test_a_track_that_was_lost_comes_back_as_in_the_tracker(seed: int) -> None:
    setup = Setup(replace(LOSING, estimator="scenario", tracker=RIGID))
    track = setup.run(seed)
    assert track.losses > 0
    assert 0.1 < track.tracked.mean() < 1.0
    published = _of_the_tracker(setup, seed)
    stamps = track.stamps_ns.tolist()
    assert [published[stamp] is not None for stamp in stamps] == track.tracked.tolist()
    positions = np.array([published[s][0] for s in track.stamps_ns[track.tracked].tolist()])
    # After a first fix of several components rounding decides what merges first.
    np.testing.assert_allclose(positions, track.mean[track.tracked, POSITION], rtol=0, atol=1e-4)
    assert np.isnan(track.error_m[~track.tracked]).all()
    assert np.isnan(track.level[~track.tracked]).all()


def test_defaults_keep_facts_only() -> None:
    config = Setup(LOSING).config
    assert config == TrackerConfig(require_initial_pose=True)
    imu = Setup(Experiment(name="x", scenario="intersection_turn", estimator="defaults")).config
    assert imu == TrackerConfig(motion_model="inertial", require_initial_pose=True)
    height = {"device_height_m", "device_height_sd_m", "device_height_time_s"}
    assert set(FACTS) == {"require_initial_pose", "motion_model", *height}


def test_defaults_and_ours_see_the_same_measurements() -> None:
    ours = Setup(replace(LOSING, estimator="scenario")).run(7)
    defaults = Setup(LOSING).run(7)
    np.testing.assert_array_equal(ours.stamps_ns, defaults.stamps_ns)
    np.testing.assert_array_equal(ours.truth[:, :4], defaults.truth[:, :4])
