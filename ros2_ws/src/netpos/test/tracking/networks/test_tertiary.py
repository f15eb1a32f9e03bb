"""The third stage: fused values by hand, order of arrival, stale networks, names, refusals."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from netpos.messages.values import NetworkTrack
from netpos.tracking.networks.config import FusionConfig
from netpos.tracking.networks.tertiary import NetworkState, TrackFusion
from netpos.tracking.report import TrackOutput

Maker = Callable[..., NetworkTrack]
NETWORKS = ("wimax", "wifi")
AT_ONCE = {"hold_s": 0.0, "confirm_s": 0.0}


def fusion(*networks: str, **values: object) -> TrackFusion:
    return TrackFusion(networks or NETWORKS, FusionConfig(**(AT_ONCE | values)))  # type: ignore[arg-type]


def feed(made: TrackFusion, *tracks: NetworkTrack) -> list[TrackOutput]:
    outputs = []
    for one in tracks:
        assert made.add(one) is None
        outputs += made.process()
    return outputs


def test_two_networks_are_fused_by_their_own_noise(track: Maker) -> None:
    made = fusion(jerk_density=0.0)
    first, second = feed(made, track("wimax", 0.0, 0.0, var=1.0), track("wifi", 0.0, 3.0, var=2.0))
    assert first.odometry is not None
    assert second.odometry is not None
    assert first.status.sources == ("wimax/vue_1",)
    assert second.status.sources == ("wimax/vue_1", "wifi/vue_1")
    assert second.status.vue_id == "vue_1"
    np.testing.assert_allclose(second.odometry.position, [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(second.odometry.pose_cov[:2, :2], 2.0 / 3.0 * np.eye(2), rtol=1e-9)


def test_the_older_track_is_moved_to_the_newer(track: Maker) -> None:
    made = fusion(method="independent", jerk_density=0.0)
    moving = track("wimax", 0.0, velocity=(10.0, 0.0))
    output = feed(made, moving, track("wifi", 0.5, 5.0, velocity=(10.0, 0.0)))[-1]
    assert output.odometry is not None
    assert output.odometry.stamp_ns == moving.stamp_ns + 500_000_000
    np.testing.assert_allclose(output.odometry.position[:2], [5.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(output.odometry.linear_velocity[:2], [10.0, 0.0], atol=1e-9)


def test_order_of_arrival_does_not_matter(track: Maker) -> None:
    """With a hold, all orders that keep each network's own give the same odometry."""
    fast = [track("wimax", 0.1 + 0.2 * k, 0.1 * k) for k in range(5)]
    slow = [track("wifi", 0.2 * k, 0.1 * k, var=9.0) for k in range(5)]
    results = []
    for places in itertools.islice(
        itertools.combinations(range(8), 4), 0, None, 9
    ):  # after the first of each
        one, two = iter(fast), iter(slow)
        made = fusion(hold_s=3.0)
        arrived = [next(two), next(one)]
        arrived += [next(one) if k in places else next(two) for k in range(8)]
        outputs = feed(made, *arrived) + made.flush()
        results.append([o.odometry for o in outputs if o.odometry is not None])
    assert len(results[0]) == 10
    for other in results[1:]:
        assert [o.stamp_ns for o in other] == [o.stamp_ns for o in results[0]]
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a.position, b.position)
            np.testing.assert_array_equal(a.pose_cov, b.pose_cov)


def test_a_network_not_heard_yet_is_waited_for(track: Maker) -> None:
    made = fusion(hold_s=1.0, stale_s=5.0)
    assert feed(made, track("wifi", 0.0), track("wifi", 0.9)) == []
    (first,) = feed(made, track("wifi", 1.0))
    assert first.odometry is not None
    assert first.odometry.stamp_ns == track("wifi", 0.0).stamp_ns


def test_once_all_are_heard_nothing_is_waited_for(track: Maker) -> None:
    made = fusion(hold_s=1.0, stale_s=5.0)
    feed(made, track("wifi", 0.0))
    stamps = [o.status.stamp_ns for o in feed(made, track("wimax", 0.0))]
    assert stamps[-1] == track("wimax", 0.0).stamp_ns
    outputs = feed(made, track("wifi", 0.5), track("wimax", 0.5))
    assert [o.status.stamp_ns for o in outputs] == [track("wifi", 0.5).stamp_ns]


def test_a_stale_network_is_left_out_and_said_so(track: Maker) -> None:
    made = fusion(stale_s=1.0)
    feed(made, track("wifi", 0.0))
    outputs = feed(made, *(track("wimax", 0.5 * k) for k in range(1, 4)))
    used = [o.status.used for o in outputs]
    assert used == [2, 2, 1]
    wimax, wifi = made.network_reports()
    assert (wimax.state, wifi.state) == (NetworkState.LIVE, NetworkState.STALE)
    assert (wimax.tracks, wifi.tracks) == (1, 0)
    assert wifi.age_s == pytest.approx(1.5)
    again = feed(made, track("wifi", 1.6))[-1]
    assert again.status.used == 2
    assert made.network_reports()[1].state is NetworkState.LIVE


def test_one_network_alone_goes_on(track: Maker) -> None:
    made = fusion()
    outputs = feed(made, *(track("wifi", 0.5 * k, float(k)) for k in range(4)))
    assert [o.status.vue_id for o in outputs] == ["wifi_vue_1"] * 4
    assert made.network_reports()[0].state is NetworkState.SILENT


def test_the_preferred_network_names_the_device_and_the_name_stays(track: Maker) -> None:
    made = fusion(stale_s=1.0)
    feed(made, track("wifi", 0.0, vue="station_7"), track("wimax", 0.1, vue="car"))
    later = feed(made, *(track("wifi", 0.5 * k, vue="station_7") for k in range(1, 6)))
    assert {o.status.vue_id for o in later} == {"car"}
    assert later[-1].status.sources == ("wifi/station_7",)


def test_networks_that_agree_on_names(track: Maker) -> None:
    made = fusion(association="names")
    far = feed(made, track("wimax", 0.0, 0.0), track("wifi", 0.0, 500.0))[-1]
    assert far.status.used == 2
    alone = feed(made, track("wifi", 0.1, vue="vue_2"))[-1]
    assert alone.status.vue_id == "vue_2"


def test_a_new_segment_is_a_new_acquaintance(track: Maker) -> None:
    """A network that starts anew on the same name may follow another device."""
    made = fusion(confirm_s=1.0)
    for k in range(4):
        feed(made, track("wimax", 0.5 * k), track("wifi", 0.5 * k))
    assert feed(made, track("wimax", 2.0))[-1].status.used == 2
    restarted = feed(made, track("wifi", 2.1, 0.0, segment=1))
    assert all(o.status.used == 1 for o in restarted)


def test_three_networks(track: Maker) -> None:
    """All noise is their own, so split intersection of the third counts it once."""
    made = fusion("a", "b", "c", jerk_density=0.0)
    tracks = [track(name, 0.0, x, var=3.0) for name, x in (("a", 0.0), ("b", 3.0), ("c", 6.0))]
    output = feed(made, *tracks)[-1]
    assert output.odometry is not None
    np.testing.assert_allclose(output.odometry.position[:2], [3.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(output.odometry.pose_cov[:2, :2], np.eye(2), rtol=1e-9)


def test_refusals_are_counted_and_change_nothing(track: Maker) -> None:
    made = fusion()
    before = feed(made, track("wimax", 5.0), track("wifi", 5.0, 1.0))[-1]
    bad = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1.0])
    assert made.add(track("wifi", 5.5, cov=bad)) == "covariance"
    assert made.add(track("wifi", 5.5, 1.0, mean=np.full(6, np.nan))) == "not_finite"
    assert made.add(track("wifi", 5.5, frame_id="odom")) == "frame"
    assert made.add(track("lte", 5.5)) == "unknown_network"
    assert made.add(track("wifi", 4.0)) == "late"
    assert made.add(track("wifi", 5.0)) == "duplicate"
    assert made.add(track("wifi", 5000.0)) == "future_stamp"
    assert made.process() == []
    after = feed(made, track("wimax", 5.0 + 1e-9))[-1]
    assert after.status.rejected == {
        "wifi: covariance": 1,
        "wifi: not_finite": 1,
        "wifi: frame": 1,
        "wifi: late": 1,
        "wifi: duplicate": 1,
        "wifi: future_stamp": 1,
        "unknown_network": 1,
    }
    assert before.odometry is not None
    assert after.odometry is not None
    np.testing.assert_allclose(after.odometry.position, before.odometry.position, atol=1e-6)
    assert made.network_reports()[1].refused["frame"] == 1


def test_time_set_back_starts_anew(track: Maker) -> None:
    made = fusion()
    feed(made, track("wimax", 1000.0))
    reasons = [made.add(track("wimax", 1.0 + k)) for k in range(10)]
    assert reasons == ["late"] * 10
    assert feed(made, track("wimax", 20.0))[-1].status.used == 1


def test_disabled_refuses(track: Maker) -> None:
    made = fusion()
    made.enabled = False
    assert made.add(track("wimax", 0.0)) == "disabled"


def test_silent_tracks_are_forgotten_and_their_place_used_again(track: Maker) -> None:
    made = fusion(stale_s=1.0, forget_s=2.0)
    feed(made, track("wifi", 0.0, vue="old"), *(track("wimax", 0.5 * k) for k in range(1, 9)))
    assert set(made._entries) == {"wimax/vue_1"}
    feed(made, track("wifi", 4.2, vue="new"))
    assert {entry.slot for entry in made._entries.values()} == {0, 1}


@pytest.mark.parametrize("networks", [(), ("a", "a")])
def test_networks_are_named_once(networks: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="networks must name each network once"):
        TrackFusion(networks)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"method": "mean"}, "method must be one of independent, ci, ici, split_ci, got 'mean'"),
        ({"stale_s": 0.0}, r"stale_s must be in \[0.01"),
        ({"forget_s": 1.0}, "forget_s must be at least stale_s"),
    ],
)
def test_config_errors(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FusionConfig.from_mapping(values)
