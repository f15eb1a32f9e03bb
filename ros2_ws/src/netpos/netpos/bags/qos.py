"""Quality of service of recorded topics, as rosbag2 notes it."""

from __future__ import annotations

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from netpos.messages.topics import CLOCK, INITIAL_POSE, RSU_INFO, RUN_TOPICS, split

INFINITE = QosTime(9223372036, 854775807)


def profile(*, reliable: bool = True, latched: bool = False, depth: int = 1000) -> Qos:
    """Keep-last profile; ``latched``: transient local, late subscribers get what was sent."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=INFINITE,
        lifespan=INFINITE,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=INFINITE,
        avoid_ros_namespace_conventions=False,
    )


def default_profile(topic: str) -> Qos:
    """What the nodes of netpos offer on ``topic``: all reliable; /rsu/info, initial poses and
    facts of the run latched."""
    if topic == CLOCK:
        return profile(depth=10)
    latched = topic in (RSU_INFO, *RUN_TOPICS) or split(topic)[1] == INITIAL_POSE
    return profile(latched=latched)


def is_latched(profiles: list[Qos]) -> bool:
    """True where every offered profile is transient local."""
    durable = QosDurability.TRANSIENT_LOCAL
    return bool(profiles) and all(p.durability == durable for p in profiles)


def is_reliable(profiles: list[Qos]) -> bool:
    """True where every offered profile is reliable, or none is known."""
    return all(p.reliability == QosReliability.RELIABLE for p in profiles)
