"""Shapes to markers, paths to the bytes of nav_msgs/Path."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Vector3
from netpos.live.shapes import Kind, Shape
from netpos.messages.fields import MAP_FRAME, NS
from netpos.messages.values import Array
from netpos.world.frames import quaternion_from_yaw
from netpos_node import CODEC
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

_TYPES = {
    Kind.ARROW: Marker.ARROW,
    Kind.BOX: Marker.CUBE,
    Kind.DISC: Marker.CYLINDER,
    Kind.LINE: Marker.LINE_STRIP,
    Kind.TEXT: Marker.TEXT_VIEW_FACING,
}
_POSE = np.dtype(  # a PoseStamped in map as it lies in the bytes of a sequence
    [
        ("sec", "<i4"),
        ("nanosec", "<u4"),
        ("frame_length", "<u4"),
        ("frame", "S4"),
        ("position", "<f8", 3),
        ("orientation", "<f8", 4),
    ]
)
_FRAME = MAP_FRAME.encode() + b"\0"
_BEFORE_POSITION = 16  # bytes; those of the first one end 4 bytes short of a multiple of 8


def marker(number: int, shape: Shape, lifetime_s: float = 0.0) -> Marker:
    """visualization_msgs/Marker of a shape; lifetime_s 0: until it is deleted. Its stamp is 0: it
    is to be shown when it comes."""
    made = Marker(ns=shape.group, id=number, type=_TYPES[shape.kind], action=Marker.ADD)
    made.header.frame_id = MAP_FRAME
    place, turn = made.pose.position, made.pose.orientation
    place.x, place.y, place.z = shape.position
    turn.x, turn.y, turn.z, turn.w = quaternion_from_yaw(shape.yaw_rad).tolist()
    x, y, z = shape.size
    made.scale = Vector3(x=x, y=y, z=z)
    red, green, blue, opacity = shape.colour
    made.color = ColorRGBA(r=red, g=green, b=blue, a=opacity)
    made.points = [Point(x=x, y=y, z=z) for x, y, z in shape.points.tolist()]
    made.text = shape.text
    whole_ns = round(NS * lifetime_s)
    made.lifetime = Duration(sec=whole_ns // NS, nanosec=whole_ns % NS)
    return made


def deletion(number: int, group: str) -> Marker:
    """The marker that takes a shape away."""
    made = Marker(ns=group, id=number, action=Marker.DELETE)
    made.header.frame_id = MAP_FRAME
    return made


def deletion_of_all() -> Marker:
    """The marker that takes all of its topic away."""
    made = Marker(action=Marker.DELETEALL)
    made.header.frame_id = MAP_FRAME
    return made


def markers(shown: Iterable[tuple[int, Shape]], lifetime_s: float = 0.0) -> list[Marker]:
    """Markers of numbered shapes."""
    return [marker(number, shape, lifetime_s) for number, shape in shown]


def path_cdr(points: Sequence[tuple[int, Array]]) -> bytes:
    """Serialised nav_msgs/Path of stamps [ns] and positions (3,) [m], stamped with the last one.

    A thousand poses as messages would take ten milliseconds of Python.
    """
    rows = np.zeros(len(points), _POSE)
    stamps = np.array([stamp for stamp, _ in points], dtype=np.int64)
    rows["sec"], rows["nanosec"] = np.divmod(stamps, NS)
    rows["frame_length"], rows["frame"] = len(_FRAME), _FRAME
    rows["position"] = np.array([position for _, position in points]).reshape(-1, 3)
    rows["orientation"][:, 3] = 1.0
    last = CODEC.time(int(stamps[-1]) if points else 0)
    head = struct.pack("<iII4sI", last.sec, last.nanosec, len(_FRAME), _FRAME, len(points))
    body = rows.tobytes()
    padding = b"\0" * 4 if points else b""
    first, rest = body[:_BEFORE_POSITION], body[_BEFORE_POSITION:]
    return b"\0\1\0\0" + head + first + padding + rest
