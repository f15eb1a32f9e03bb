"""An initial pose is a hypothesis: the measurements may exclude it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Array, Field, InitialPose, RsuInfo, RsuMeasurement, TrackState
from netpos.tracking import Tracker, TrackerConfig

S = 1_000_000_000
TRUE = np.array([20.0, 15.0])
SITES = {"a": (0.0, 0.0), "b": (60.0, 0.0), "c": (60.0, 60.0)}
QUANTITIES = {
    Field.RANGE: {"range_var": 0.01},
    Field.AZIMUTH: {"azimuth_var": 1e-4},
    Field.TOA: {"toa_var": (0.1 / 299792458.0) ** 2},
}


def tracker_of(**config: Any) -> Tracker:
    tracker = Tracker(TrackerConfig(hold_s=0.0, **config))
    for name, site in SITES.items():
        tracker.add_rsu(RsuInfo(rsu_id=name, position=np.array([*site, 0.0])))
    return tracker


def heard(
    tracker: Tracker, epochs: range, fields: Field = Field.RANGE, names: str = "abc"
) -> list[Any]:
    outputs = []
    for k in epochs:
        rng = np.random.default_rng(k)
        for name in names:
            d = TRUE - SITES[name]
            m = RsuMeasurement(
                stamp_ns=S + k * S // 10,
                rsu_id=name,
                vue_id="vue_1",
                fields=fields,
                range_m=float(np.hypot(*d) + 0.1 * rng.standard_normal()),
                toa_s=float(np.hypot(*d) + 0.1 * rng.standard_normal()) / 299792458.0,
                azimuth_rad=float(np.arctan2(d[1], d[0]) + 0.01 * rng.standard_normal()),
            )
            for field, variance in QUANTITIES.items():
                if field & fields:
                    m = replace(m, **variance)
            tracker.add(m)
        outputs += tracker.process()
    return outputs


def pose(tracker: Tracker, place: Array, sd_m: float, k: int) -> list[Any]:
    cov = sd_m**2 * np.eye(3)
    position = np.array([*place, 0.0])
    stamp_ns = S + k * S // 10 + 1
    tracker.add(InitialPose(stamp_ns=stamp_ns, vue_id="vue_1", position=position, cov=cov))
    return tracker.process()


def error_m(output: Any, place: Array = TRUE) -> float:
    return float(np.linalg.norm(output.odometry.position[:2] - place))


@pytest.mark.parametrize("fields", [Field.RANGE, Field.AZIMUTH, Field.TOA | Field.AZIMUTH])
@pytest.mark.parametrize("aside_m", [20.0, 1e5])
def test_a_pose_that_is_impossible_is_refused(fields: Field, aside_m: float) -> None:
    tracker = tracker_of()
    heard(tracker, range(30), fields)
    outputs = pose(tracker, TRUE + np.array([aside_m, 0.0]), 1e-3, 29)
    outputs += heard(tracker, range(30, 40), fields)
    assert all(error_m(o) < 1.0 for o in outputs)
    assert all(o.status.state is TrackState.TRACKING for o in outputs)
    assert outputs[-1].status.rejected["initialpose"] == 1
    (finding,) = [
        f for f in tracker.findings({"vue_1": outputs[-1].status}, {}) if f.subject == "vue_1"
    ]
    assert "1 initialpose refused: the measurements exclude it" in finding.message


def test_a_pose_that_fits_starts_the_track_anew() -> None:
    tracker = tracker_of()
    heard(tracker, range(30))
    (output,) = pose(tracker, TRUE + np.array([0.5, 0.0]), 0.3, 29)
    assert "initialpose" not in output.status.rejected
    np.testing.assert_allclose(
        output.odometry.position[:2], TRUE + np.array([0.5, 0.0]), atol=1e-9
    )


def test_an_operator_may_turn_a_mirrored_track() -> None:
    """Ranges of two RSUs on a line fit two places: both poses are possible."""
    tracker = tracker_of()
    mirrored = TRUE * [1.0, -1.0]
    pose(tracker, mirrored, 1.0, 0)
    before = heard(tracker, range(1, 20), names="ab")
    assert error_m(before[-1], mirrored) < 1.0
    pose(tracker, TRUE, 1.0, 19)
    after = heard(tracker, range(20, 30), names="ab")
    assert error_m(after[-1]) < 1.0
    pose(tracker, TRUE + np.array([0.0, 30.0]), 1e-3, 29)
    after = heard(tracker, range(30, 40), names="ab")
    assert error_m(after[-1]) < 1.0
    assert after[-1].status.rejected["initialpose"] == 1


def test_a_pose_before_and_long_after_measurements_is_taken() -> None:
    tracker = tracker_of()
    (first,) = pose(tracker, TRUE, 1.0, 0)
    assert error_m(first) < 1e-9
    heard(tracker, range(1, 20))
    far = TRUE + np.array([500.0, 0.0])
    (late,) = pose(tracker, far, 1.0, 100)  # 8 s of silence: it may have moved
    assert error_m(late, far) < 1e-9


def test_poses_can_be_switched_off() -> None:
    tracker = tracker_of(accept_initialpose=False)
    outputs = pose(tracker, TRUE, 1.0, 0)
    assert all(o.odometry is None for o in outputs)
    assert tracker.rejected()["vue_1"]["initialpose_off"] == 1
    assert "set accept_initialpose" in tracker.refusals.of_device("vue_1").words()
    with pytest.raises(ValueError, match="require_initial_pose needs accept_initialpose"):
        TrackerConfig(require_initial_pose=True, accept_initialpose=False)
