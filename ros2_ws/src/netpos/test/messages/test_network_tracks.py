"""Tracks of networks to messages, to bytes and back."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from netpos.bags import codec, typestore
from netpos.messages import topics
from netpos.messages.network_tracks import (
    TYPE_NAME,
    network_track_from_msg,
    network_track_to_msg,
)
from netpos.messages.values import NetworkTrack


def test_every_field_survives() -> None:
    track = NetworkTrack(
        stamp_ns=1_700_000_000_123_456_789,
        network="wifi",
        vue_id="station_7",
        mean=np.arange(6) + 0.5,
        cov=np.arange(36).reshape(6, 6) + 0.25,
        own_cov=np.arange(36).reshape(6, 6) + 0.125,
        segment=3,
        frame_id="odom",
        height_m=1.5,
    )
    store = typestore()
    msg = network_track_to_msg(codec(), track)
    again = store.deserialize_cdr(store.serialize_cdr(msg, TYPE_NAME), TYPE_NAME)
    back = network_track_from_msg(again)
    for entry in fields(NetworkTrack):
        a, b = getattr(track, entry.name), getattr(back, entry.name)
        np.testing.assert_array_equal(a, b, err_msg=entry.name)
        assert np.shape(a) == np.shape(b), entry.name
    assert back.source == "wifi/station_7"


def test_topics_of_a_network() -> None:
    assert topics.tracks_of("wifi") == "/networks/wifi/tracks"
    assert topics.of_vue("vue_1", topics.ODOMETRY, "wifi") == "/networks/wifi/vue_1/odometry"
    for topic in ("/networks/wifi/tracks", "/networks/wifi/vue_1/odometry"):
        assert topics.is_tracker_output(topic)
        assert topics.split(topic) == ("", topic)
