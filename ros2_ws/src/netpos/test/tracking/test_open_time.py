"""A turn that nothing has shown is no older than what was last told of turns."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.messages.values import Field, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker
from netpos.tracking.config import TrackerConfig
from track_cases import T0

SPEED_MPS = 10.0
SPACING_M = 30.0
ANGLE_SD = math.radians(2.0)


@pytest.mark.parametrize("seed", range(5))
def test_two_rsus_in_line_do_not_leave_turns_open_for_ever(seed: int) -> None:
    """A car passes RSUs on both sides of a road, which measure directions. Those of two between
    which it drives hardly show where along the line it is, and one of them may not be heard. That
    it is between the two they show."""
    rng = np.random.default_rng(seed)
    tracker = Tracker(TrackerConfig(accel_density_mps2_sqrthz=2.0, initial_speed_sd_mps=10.0))
    sites = np.column_stack([SPACING_M * np.arange(14), np.tile([-8.0, 8.0], 7)])
    for i, site in enumerate(sites):
        tracker.add_rsu(RsuInfo(rsu_id=f"r{i}", position=np.array([*site, 0.0])))
    sds, away = [], []
    for k in range(380):
        place = np.array([10.0 + SPEED_MPS * k / 10.0, 0.3])
        near = np.flatnonzero(np.hypot(*(place - sites).T) < 33.0)
        heard = [i for i in near if rng.random() > 0.2]
        for i in heard:
            d = place - sites[i]
            tracker.add(
                RsuMeasurement(
                    stamp_ns=T0 + k * 100_000_000,
                    rsu_id=f"r{i}",
                    vue_id="vue_1",
                    sequence=k,
                    expected=len(heard),
                    fields=Field.AZIMUTH,
                    azimuth_rad=math.atan2(d[1], d[0]) + rng.normal(0.0, ANGLE_SD),
                    azimuth_var=ANGLE_SD**2,
                )
            )
        for output in tracker.process():
            if output.odometry is not None:
                cov = output.odometry.pose_cov[:2, :2]
                sds.append(math.sqrt(np.linalg.eigvalsh(cov)[-1]))
                away.append(float(np.hypot(*(output.odometry.position[:2] - place))))
    assert len(sds) > 300
    assert max(sds) < SPACING_M / 2.0
    assert max(away) < SPACING_M / 2.0
