"""The second stage: the own share of a track, whose measurements count, what is reported."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from netpos.messages.values import Array, Field, NetworkTrack, RsuInfo, RsuMeasurement
from netpos.tracking import Tracker, TrackerConfig

NS = 1_000_000_000


def tracker(**values: Any) -> Tracker:
    plain = {
        "network": "wifi",
        "filter": "kf",
        "motion_model": "constant_acceleration",
        "initial_position_sd_max_m": 20.0,
        "gate_probability": 1.0,
        "hold_s": 0.0,
    }
    made = Tracker(TrackerConfig(**(plain | values)))
    for rsu, network in (("ap", "wifi"), ("base", "wimax")):
        made.add_rsu(RsuInfo(rsu_id=rsu, position=np.zeros(3), network=network))
    return made


def fix(k: int, noise: Array, rsu: str = "ap") -> RsuMeasurement:
    return RsuMeasurement(
        stamp_ns=NS + k * NS // 2,
        rsu_id=rsu,
        vue_id="phone",
        expected=1,
        fields=Field.POSITION,
        position=np.array([2.0 * k, -1.0 * k, 0.0]) + np.append(noise, 0.0),
        position_cov=np.diag([4.0, 9.0, 1.0]),
    )


def tracks(made: Tracker, noise: Array) -> list[NetworkTrack]:
    found = []
    for k, error in enumerate(noise):
        assert made.add(fix(k, error)) is None
        found += [out.track for out in made.process() if out.track is not None]
    return found


@pytest.mark.parametrize(
    "floor",
    [{}, {"position_gain_min": 0.3, "velocity_gain_min": 0.1, "accel_gain_min": 0.02}],
)
def test_own_share_is_the_spread_that_the_fixes_noise_makes(floor: dict[str, float]) -> None:
    """After the first fix: perturb each fix by itself and add up what becomes of the track."""
    n, first = 14, 6
    plain = tracks(tracker(**floor), np.zeros((n, 2)))
    start = next(i for i, t in enumerate(plain) if t.own_cov.any())
    assert start < first
    heard = n - len(plain)
    expected = np.zeros((6, 6))
    for k in range(heard + start, n):
        for axis, variance in enumerate((4.0, 9.0)):
            noise = np.zeros((n, 2))
            noise[k, axis] = 1.0
            effect = tracks(tracker(**floor), noise)[-1].mean - plain[-1].mean
            expected += variance * np.outer(effect, effect)
    np.testing.assert_allclose(plain[-1].own_cov, expected, rtol=1e-6, atol=1e-9)
    assert np.linalg.eigvalsh(plain[-1].cov - plain[-1].own_cov)[0] > -1e-9


def test_fixes_of_other_networks_are_left_to_their_trackers() -> None:
    made, alone = tracker(), tracker()
    for k in range(8):
        for one in (made, alone):
            assert one.add(fix(k, np.zeros(2))) is None
            one.process()
        assert made.add(fix(k, np.full(2, 500.0), rsu="base")) is None
        assert made.process() == []
    assert made.rejected() == alone.rejected() == {"phone": {}}
    assert made.add(fix(9, np.zeros(2), rsu="nobody")) == "unknown_rsu"


def test_report() -> None:
    found = tracks(tracker(device_height_m=1.5), np.zeros((12, 2)))
    newest = found[-1]
    assert (newest.network, newest.vue_id, newest.segment) == ("wifi", "phone", 0)
    assert newest.height_m == 1.5
    assert newest.stamp_ns == NS + 11 * NS // 2
    np.testing.assert_allclose(newest.mean, [22.0, -11.0, 4.0, -2.0, 0.0, 0.0], atol=0.2)


def test_a_model_without_acceleration_and_a_filter_without_shares() -> None:
    found = tracks(
        tracker(filter="iekf", motion_model="constant_velocity", accel_state_sd_mps2=3.0),
        np.zeros((12, 2)),
    )
    newest = found[-1]
    assert newest.mean[4:].tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(newest.cov[4:, 4:], 9.0 * np.eye(2))
    assert not newest.own_cov.any()


def test_without_a_network_nothing_is_reported() -> None:
    made = tracker(network="")
    made.add(fix(0, np.zeros(2)))
    assert all(out.track is None and out.network == "" for out in made.process())


def test_late_fixes_revise_the_share() -> None:
    """Out of order within the history, the own share is that of arrival in order."""
    orderly, late = tracker(history_s=3.0), tracker(history_s=3.0)
    last: dict[str, NetworkTrack] = {}
    for name, made, order in (
        ("orderly", orderly, range(12)),
        ("late", late, [*range(9), 10, 9, 11]),
    ):
        for k in order:
            made.add(fix(k, np.array([0.1 * k, 0.0])))
            for out in made.process():
                if out.track is not None:
                    last[name] = out.track
    np.testing.assert_array_equal(last["late"].own_cov, last["orderly"].own_cov)
    np.testing.assert_array_equal(last["late"].mean, last["orderly"].mean)


def test_a_track_is_in_the_frame_of_its_map() -> None:
    made = Tracker(TrackerConfig(network="wifi", hold_s=0.0, map_frame="site"))
    made.add_rsu(RsuInfo(rsu_id="ap", position=np.zeros(3), network="wifi", frame_id="site"))
    found = []
    for k in range(6):
        measured = fix(k, np.zeros(2))
        measured.frame_id = "site"
        assert made.add(measured) is None
        found += [out.track for out in made.process() if out.track is not None]
    assert {track.frame_id for track in found} == {"site"}
