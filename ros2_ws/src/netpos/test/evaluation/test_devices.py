"""Several devices scored as one, against figures made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.evaluation.contents import Delivery
from netpos.evaluation.devices import together
from netpos.evaluation.evaluate import VueEvaluation
from netpos.evaluation.metrics import Run, score
from netpos.evaluation.pairing import Trajectory
from netpos.evaluation.yardsticks import ranges
from netpos.messages.values import Array, Odometry, TrackState, TrackStatus

S = 1_000_000_000
LEVEL_M = 2.5
DELIVERY = Delivery(
    beacons=None,
    epochs=0,
    received=0,
    duplicates=0,
    out_of_order=0,
    expected=None,
    missing=None,
)
WAITING, INITIALISING, TRACKING = TrackState.WAITING, TrackState.INITIALISING, TrackState.TRACKING


def pose(t_s: float, place: Array, sd_m: float = 0.0) -> Odometry:
    return Odometry(
        stamp_ns=round(t_s * S),
        vue_id="v",
        position=place,
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        linear_velocity=np.zeros(3),
        pose_cov=np.eye(6) * sd_m**2,
    )


def device(begin_s: float, errors_m: list[float], states: list[TrackState]) -> VueEvaluation:
    """One that stands, estimated once a second with errors to the east, one of every four
    measurements refused."""
    times = [begin_s + k for k in range(len(errors_m))]
    truth = Trajectory.of(pose(t, np.zeros(3)) for t in times)
    estimate = Trajectory.of(
        pose(t, np.array([e, 0.0, 0.0]), 1.0)
        for t, e, state in zip(times, errors_m, states, strict=True)
        if state is not WAITING
    )
    statuses = [
        TrackStatus(
            stamp_ns=round(t * S),
            vue_id="v",
            state=state,
            nis=2.0,
            nis_dof=2,
            accepted=3 * (k + 1),
            rejected={"gate": k + 1},
            protection_level_m=LEVEL_M,
        )
        for k, (t, state) in enumerate(zip(times, states, strict=True))
    ]
    run = Run(truth=truth, estimate=estimate, statuses=statuses)
    return VueEvaluation(run=run, scored=score(run, skip=0), verdicts=(), delivery=DELIVERY)


DEVICES = {
    "a": device(100.0, [9.0, 1.0, -2.0], [INITIALISING, TRACKING, TRACKING]),
    "b": device(1.0, [3.0, 1.0], [TRACKING, WAITING]),
    "c": device(50.0, [5.0], [WAITING]),
}


def test_errors_of_all_devices_count_alike() -> None:
    found = together(DEVICES)
    figures = found.figures
    assert figures.n == 3  # not the 9 m of INITIALISING, and nothing of a device without a track
    assert figures.rmse_m == pytest.approx(math.sqrt((1.0 + 4.0 + 9.0) / 3))
    assert figures.max_m == pytest.approx(3.0)
    assert figures.nees_mean == pytest.approx((1.0 + 4.0 + 9.0) / 3)
    assert figures.protection_exceeded == pytest.approx(1 / 3)
    assert figures.nis_mean == pytest.approx(2.0)
    assert found.counted_ns.tolist() == found.run.estimate.stamp_ns.tolist()


def test_what_the_runs_lack_is_added_up() -> None:
    figures = together(DEVICES).figures
    assert figures.lost_tracks == 1  # of b; that a ends and b begins is no loss
    assert figures.rejected == 3 + 2 + 1
    assert figures.rejected_share == pytest.approx(0.25)
    each = [vue.figures for vue in DEVICES.values()]
    assert figures.unscored_s == pytest.approx(sum(f.unscored_s or 0.0 for f in each))
    spans, shares = [2.0, 1.0], [each[0].availability or 0.0, each[1].availability or 0.0]
    assert figures.availability == pytest.approx(np.dot(spans, shares) / 3.0)
    assert figures.initial.time_to_ready_s == pytest.approx(0.5)  # of 1 s and 0 s


def test_devices_follow_one_another_far_apart_and_so_do_their_measurements() -> None:
    found = together(DEVICES)
    assert list(found.offset_ns) == list(DEVICES)
    assert found.offset_ns["a"] == 0
    assert (np.diff(found.run.truth.stamp_ns) > 0).all()
    seen = {
        name: ranges(
            vue.run.truth.stamp_ns,
            np.zeros((len(vue.run.truth), 3)),
            [7.0] * len(vue.run.truth),
            0.1,
        )
        for name, vue in DEVICES.items()
    }
    assert found.observations(seen).stamp_ns.tolist() == found.run.truth.stamp_ns.tolist()


def test_one_device_is_itself() -> None:
    only = DEVICES["a"]
    found = together({"a": only})
    assert found.figures is only.figures
    assert found.run is only.run
    assert found.counted_ns.tolist() == only.scored.counted.estimate.stamp_ns.tolist()
