"""Values of the ROS messages, and their conversion to and from messages (``codec``).

A program imports from here what a ``Tracker`` or a bag takes and gives besides ``RsuInfo`` and
``RsuMeasurement``: ``from netpos.messages import ImuSample``. They have the fields of the ROS
messages and change with these.

The codec works with any message classes that have the fields of the ROS interfaces: those of
``rclpy`` in a node, those of ``rosbags`` offline. So live and offline runs write and read the
same bytes.
"""

from netpos.messages.values import (
    ClockState,
    GroundSpeed,
    ImuSample,
    InitialPose,
    Odometry,
    TrackMode,
    TrackState,
    TrackStatus,
    Velocity,
)

__all__ = [
    "ClockState",
    "GroundSpeed",
    "ImuSample",
    "InitialPose",
    "Odometry",
    "TrackMode",
    "TrackState",
    "TrackStatus",
    "Velocity",
]
