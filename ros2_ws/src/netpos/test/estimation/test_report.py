"""The level of one epoch by hand; the levels of a compiled run are those its tracker reports."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation.level.report import LEVEL_MAX_M, level_of
from netpos.estimation.state import POSITION
from netpos.reproduction.experiment import Experiment, Setup
from setup_tracker import tracker_outputs


@pytest.mark.parametrize(
    ("radius_m", "inflation", "undetected_m", "unheard_s", "level_m"),
    [
        (2.0, 1.5, 0.0, 0.0, 3.0),  # an optimistic filter
        (2.0, 1.0, 2.5, 0.0, 2.5),  # a manoeuvre that would not show
        (2.0, 1.5, 2.5, 0.0, 3.75),  # which larger errors hide longer
        (2.0, 1.0, 2.5, 0.5, 5.0),  # which has gone on at 5 m/s since
        (2.0, 1.0, np.inf, 0.0, LEVEL_MAX_M),  # that nothing bounds
    ],
)
def test_level_of_one_epoch(
    radius_m: float, inflation: float, undetected_m: float, unheard_s: float, level_m: float
) -> None:
    assert level_of(radius_m, inflation, undetected_m, 5.0, unheard_s) == level_m


@pytest.mark.parametrize(
    ("speed", "interval_s", "rsus", "seed"),
    [(5.9, 0.1673, 2, 5003), (0.0, 0.1673, 2, 5003), (5.9, 0.01673, 1, 5067)],
)
def test_levels_are_those_of_the_tracker(
    speed: float, interval_s: float, rsus: int, seed: int
) -> None:
    """Past a turn of METIS, with one RSU as a mixture; without manoeuvres the
    level is that of the covariance."""
    experiment = Experiment(
        name="past a turn",
        scenario="metis_madrid_strong_signal",
        changes=(
            ("devices.0.beacon_interval_s", interval_s),
            ("measurement.nearest", rsus),
            ("max_duration_s", 40.0),
        ),
        tracker=(("manoeuvre_speed_sd_mps", speed), ("isolate_rsus", False)),
    )
    setup = Setup(experiment)
    track = setup.run(seed)
    outputs = tracker_outputs(setup, seed)
    levels = {o.status.stamp_ns: o.status.protection_level_m for o in outputs}
    reported = np.array([levels[stamp] for stamp in track.stamps_ns.tolist()])
    assert len(track.level) > 200
    apart = np.abs(track.level - reported) > 1e-9 * reported
    assert apart.sum() == 0
    assert (track.level > 0.0).all()
    positions = {o.status.stamp_ns: o.odometry.position for o in outputs if o.odometry}
    published = np.array([positions[stamp][:2] for stamp in track.stamps_ns.tolist()])
    astray = np.hypot(*(track.mean[:, POSITION] - published).T) > 1e-6
    assert astray.sum() == 0


@pytest.mark.parametrize("seed", [5132, 5511])
def test_a_turn_along_the_bearing_of_one_rsu_is_held(seed: int) -> None:
    """No single measurement tells of these turns. A filter of one component drifts off by 23 m,
    sure of it to less than one, and 238 and 597 errors are above its level."""
    changes = (("devices.0.beacon_interval_s", 100 * 167.3e-6), ("measurement.nearest", 1))
    experiment = Experiment(name="x", scenario="metis_madrid_strong_signal", changes=changes)
    track = Setup(experiment).run(seed)
    error, level = track.error_m[20:], track.level[20:]
    assert track.losses == 0
    assert (error > level).sum() < 20
    assert np.sqrt(np.mean(error**2)) < 2.5
    assert np.median(level) < 5.0
