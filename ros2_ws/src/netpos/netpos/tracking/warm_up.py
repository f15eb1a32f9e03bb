"""Compile the tracker's kernels before the first measurement arrives."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from netpos.estimation.motion import NO_BIAS
from netpos.estimation.rows import linear_rows
from netpos.messages.values import Field, GroundSpeed, InitialPose, RsuInfo, RsuMeasurement
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.estimates import Estimate
from netpos.tracking.ordering.sequencer import Item
from netpos.tracking.tracker import Tracker

_VUE = "warm_up"


def warm_up(network: str | None = None) -> None:
    """Run tiny tracks through the kernels: first fix, prediction, gate, update.

    network : of the tracker, "" where it takes all; None: every kernel, as at set-up. Those for
        anchors follow with the first anchor (``warm_up_anchors``): a kernel that is only loaded
        costs a tracker memory and time, too.
    """
    _angles_and_ranges()
    _components()
    if network is None:
        warm_up_anchors()
        Tracker(TrackerConfig(motion_model="strapdown", robust="huber"))
    if network != "":
        _fixes_of_a_network()


def _components() -> None:
    """Two epochs of a mixture, the first of which begins it by a refused fix."""
    config = TrackerConfig()
    estimate = Estimate(config, 0, np.zeros(6), np.eye(6))
    for k in (1, 2):
        rows = linear_rows(np.full(2, 9.0), np.eye(2) / 100.0, np.eye(2, 6), 0)
        estimate.step(k * 100_000_000, 0.1, 0, rows, NO_BIAS)
    estimate.radius(float(len(estimate.modes)))


@cache
def warm_up_anchors() -> None:
    """Two epochs of an ambiguous phase; once in a process."""
    anchor = RsuInfo(rsu_id="a", position=np.zeros(3), baseline_m=0.2, wavelength_m=0.1)
    fields = Field.RANGE | Field.PHASE
    values = {"range_m": 10.0, "range_var": 0.01, "phase_difference_var": 0.01}
    _track(
        TrackerConfig(hold_s=0.0), [anchor], [_measured(k, "a", fields, values) for k in (1, 2)]
    )


def _fixes_of_a_network() -> None:
    config = TrackerConfig(
        network="n", hold_s=0.0, filter="kf", motion_model="constant_acceleration"
    )
    rsu = RsuInfo(rsu_id="a", position=np.zeros(3), network="n")
    fix = {"position": np.array([1.0, 1.0, 0.0]), "position_cov": np.eye(3)}
    _track(config, [rsu], [_measured(k, "a", Field.POSITION, fix) for k in range(1, 5)])


def _angles_and_ranges() -> None:
    position, items = np.array([10.0, 10.0, 0.0]), []
    rsus = [RsuInfo(rsu_id=n, position=np.array([x, 0.0, 0.0])) for n, x in (("a", 0), ("b", 40))]
    for k in range(1, 5):
        for rsu in rsus:
            d = position - rsu.position
            values = {
                "azimuth_rad": float(np.arctan2(d[1], d[0])),
                "azimuth_var": 1e-4,
                "range_m": float(np.hypot(d[0], d[1])),
                "range_var": 0.01,
            }
            items.append(_measured(k, rsu.rsu_id, Field.AZIMUTH | Field.RANGE, values))
    speed = GroundSpeed(stamp_ns=500_000_000, vue_id=_VUE, speed_mps=0.1, speed_var=0.01)
    pose = InitialPose(stamp_ns=600_000_000, vue_id=_VUE, position=position, cov=np.eye(3))
    _track(TrackerConfig(hold_s=0.0), rsus, [*items, speed, pose])


def _measured(k: int, rsu_id: str, fields: Field, values: dict[str, Any]) -> RsuMeasurement:
    """What an RSU measures in epoch ``k``."""
    return RsuMeasurement(
        stamp_ns=k * 100_000_000, rsu_id=rsu_id, vue_id=_VUE, fields=fields, **values
    )


def _track(config: TrackerConfig, rsus: Sequence[RsuInfo], items: Sequence[Item]) -> None:
    tracker = Tracker(config, rsus)
    for item in items:
        tracker.add(item)
        tracker.process()
