"""Tracks of networks to messages and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from netpos.messages.codec import Codec
from netpos.messages.fields import flat, square, stamp_ns
from netpos.messages.values import NetworkTrack

TYPE_NAME = "netpos_msgs/msg/NetworkTrack"


def network_track_to_msg(codec: Codec, track: NetworkTrack) -> Any:
    """netpos_msgs/NetworkTrack."""
    return codec.message_class(TYPE_NAME)(
        header=codec.header(track.stamp_ns, track.frame_id),
        network=track.network,
        vue_id=track.vue_id,
        segment=track.segment,
        state=np.ascontiguousarray(track.mean, dtype=np.float64),
        covariance=flat(track.cov),
        own_covariance=flat(track.own_cov),
        height=float(track.height_m),
    )


def network_track_from_msg(msg: Any) -> NetworkTrack:
    """NetworkTrack value of a netpos_msgs/NetworkTrack; values are not judged here."""
    return NetworkTrack(
        stamp_ns=stamp_ns(msg.header.stamp),
        frame_id=msg.header.frame_id,
        network=msg.network,
        vue_id=msg.vue_id,
        segment=int(msg.segment),
        mean=np.array(msg.state, dtype=np.float64),
        cov=square(msg.covariance, 6).copy(),
        own_cov=square(msg.own_covariance, 6).copy(),
        height_m=float(msg.height),
    )
