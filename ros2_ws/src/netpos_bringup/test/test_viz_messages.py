"""Markers and paths as rclpy reads them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from nav_msgs.msg import Path
from netpos.live.shapes import Kind, Shape
from netpos_bringup.viz_messages import deletion, deletion_of_all, marker, path_cdr
from rclpy.serialization import deserialize_message, serialize_message
from visualization_msgs.msg import Marker

NS = 1_000_000_000
LINE = Shape(
    group="lines of sight",
    name="a vue_1",
    kind=Kind.LINE,
    colour=(0.25, 0.5, 0.75, 1.0),
    size=(0.3, 0.0, 0.0),
    points=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
)


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_the_bytes_of_a_path_are_those_of_its_message(count: int) -> None:
    rng = np.random.default_rng(count)
    points = [(3 * NS + 17 * k, rng.normal(size=3)) for k in range(count)]
    read = deserialize_message(path_cdr(points), Path)
    assert read.header.frame_id == "map"
    assert len(read.poses) == count
    for pose, (stamp_ns, position) in zip(read.poses, points, strict=True):
        assert pose.header.frame_id == "map"
        assert pose.header.stamp.sec * NS + pose.header.stamp.nanosec == stamp_ns
        place, turn = pose.pose.position, pose.pose.orientation
        assert [place.x, place.y, place.z] == position.tolist()
        assert [turn.x, turn.y, turn.z, turn.w] == [0.0, 0.0, 0.0, 1.0]
    if count:
        assert read.header.stamp == read.poses[-1].header.stamp
    assert len(serialize_message(read)) == len(path_cdr(points))


def test_a_marker_is_its_shape() -> None:
    made = marker(7, LINE, 2.5)
    assert (made.ns, made.id, made.type, made.action) == (
        "lines of sight",
        7,
        Marker.LINE_STRIP,
        Marker.ADD,
    )
    assert made.header.frame_id == "map"
    assert (made.header.stamp.sec, made.header.stamp.nanosec) == (0, 0)
    assert [(p.x, p.y, p.z) for p in made.points] == [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]
    assert (made.scale.x, made.color.r, made.color.g, made.color.b) == (0.3, 0.25, 0.5, 0.75)
    assert (made.lifetime.sec, made.lifetime.nanosec) == (2, 500_000_000)


def test_a_turned_shape() -> None:
    arrow = Shape(
        group="devices",
        name="vue_1",
        kind=Kind.ARROW,
        colour=(1.0, 1.0, 1.0, 1.0),
        size=(4.0, 1.0, 1.0),
        position=(1.0, 2.0, 3.0),
        yaw_rad=math.pi / 2,
        text="north",
    )
    made = marker(0, arrow)
    turn = made.pose.orientation
    assert (turn.z, turn.w) == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))
    assert (made.type, made.text) == (Marker.ARROW, "north")
    assert (made.lifetime.sec, made.lifetime.nanosec) == (0, 0)


@pytest.mark.parametrize("kind", list(Kind))
def test_every_kind_of_shape_has_a_type_of_marker(kind: Kind) -> None:
    shape = Shape(group="g", name="n", kind=kind, colour=(1.0,) * 4, size=(1.0, 1.0, 1.0))  # type: ignore[arg-type]
    assert marker(0, shape).type in range(12)


def test_deletions() -> None:
    assert (deletion(3, "modes").ns, deletion(3, "modes").id) == ("modes", 3)
    assert deletion(3, "modes").action == Marker.DELETE
    assert deletion_of_all().action == Marker.DELETEALL
