"""Quality of service and stamps between ROS and the bag."""

from __future__ import annotations

import struct
from collections.abc import Iterable

from netpos.bags.qos import is_latched, is_reliable
from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

NS = 1_000_000_000
RECORD_DEPTH = 10_000  # messages of one topic that may wait while the recorder is busy
PLAY_DEPTH = 20_000  # messages of one topic kept until acknowledged, which takes up to 3 s


def clock_ns(cdr: bytes) -> int:
    """Time of a serialised rosgraph_msgs/Clock."""
    order = "<" if cdr[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", cdr, 4)
    return int(seconds) * NS + int(nanoseconds)


def clock_cdr(time_ns: int) -> bytes:
    """Serialised rosgraph_msgs/Clock."""
    return b"\x00\x01\x00\x00" + struct.pack("<iI", *divmod(time_ns, NS))


def profile_to_bag(profile: QoSProfile) -> Qos:
    """A publisher's offered profile, as the bag notes it."""

    def time(duration: Duration) -> QosTime:
        return QosTime(*divmod(duration.nanoseconds, NS))

    return Qos(
        history=QosHistory[profile.history.name],
        depth=profile.depth,
        reliability=QosReliability[profile.reliability.name],
        durability=QosDurability[profile.durability.name],
        deadline=time(profile.deadline),
        lifespan=time(profile.lifespan),
        liveliness=QosLiveliness[profile.liveliness.name],
        liveliness_lease_duration=time(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def unique(profiles: Iterable[Qos]) -> list[Qos]:
    """Profiles in order, each once."""
    return list(dict.fromkeys(profiles))


def _profile(profiles: list[Qos], depth: int) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=(
            ReliabilityPolicy.RELIABLE if is_reliable(profiles) else ReliabilityPolicy.BEST_EFFORT
        ),
        durability=(
            DurabilityPolicy.TRANSIENT_LOCAL if is_latched(profiles) else DurabilityPolicy.VOLATILE
        ),
        liveliness=LivelinessPolicy.AUTOMATIC,
    )


def profile_to_record(offered: list[Qos]) -> QoSProfile:
    """The strongest profile that every publisher of the topic can serve."""
    return _profile(offered, RECORD_DEPTH)


def profile_to_play(recorded: list[Qos]) -> QoSProfile:
    """The recorded reliability and durability, deep enough for what is not acknowledged yet."""
    return _profile(recorded, max([PLAY_DEPTH, *(p.depth for p in recorded)]))
