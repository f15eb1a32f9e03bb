"""Draw the pictures of docs/live_view.md from running graphs: python scripts/live_pictures.py
[FOLDER]. Markers of METIS come by ROS, those of pedestrian_rectangle by the WebSocket of live."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon, Rectangle
from nav_msgs.msg import Path as PathMsg
from netpos.evaluation.pictures import save
from netpos.live.board import Board
from netpos.live.client import DEFAULT_URL, Viewer
from netpos.live.screen import screen
from netpos.messages import topics
from netpos.world.frames import yaw_from_quaternion
from rclpy.qos import DurabilityPolicy, QoSProfile
from rich.console import Console, RenderableType
from visualization_msgs.msg import Marker, MarkerArray

DOMAIN = 93
PATIENCE_S = 180.0
BACKGROUND = "#282828"  # as in the RViz configuration
PATH_COLOUR = "#009E73"
STATUS_WIDTH = 132  # characters
FONTS = re.compile(r"@font-face \{.*?\n    \}\n", re.DOTALL)  # which a browser would fetch
PATH_TOPIC = topics.path_of("vue_1")


@dataclass
class Picture:
    """The newest messages to draw."""

    map: Any = None
    markers: Any = None
    path: Any = None
    groups: set[str] = field(default_factory=set)

    def take(self, topic: str, message: Any) -> None:
        """Keep a message."""
        if topic == topics.VIZ_MAP:
            self.map = message
        elif topic == PATH_TOPIC:
            self.path = message
        else:
            self.markers = message
            self.groups = {m.ns for m in message.markers if m.action == Marker.ADD}


@contextmanager
def process(*command: str) -> Iterator[subprocess.Popen[str]]:
    """A program that runs until the end of the block."""
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as popen:
        try:
            yield popen
        finally:
            os.killpg(popen.pid, signal.SIGINT)


@contextmanager
def running(scenario: str, rate: float, size_m: float) -> Iterator[str]:
    """A scenario's graph with viz and live; the address of live."""
    with ExitStack() as stack:

        def node(*names: str, **parameters: Any) -> subprocess.Popen[str]:
            flags = [word for k, v in parameters.items() for word in ("-p", f"{k}:={v}")]
            more = ["--ros-args", *flags] if flags else []
            return stack.enter_context(process("ros2", "run", *names, *more))

        node("netpos_bringup", "viz", size_m=size_m)
        live = node("netpos_bringup", "live", "--port", "0")
        node("ekf_tracker", "ekf_tracker", scenario=scenario)
        node("rsu_sensor", "rsu_sensor", scenario=scenario, subscribers=1)
        if scenario == "pedestrian_rectangle":
            node("pdr_node", "pdr_node", scenario=scenario, vue="vue_1", subscribers=1)
        node("vue_sim", "vue_sim", scenario=scenario, subscribers=1, rate=rate)
        assert live.stdout is not None
        yield live.stdout.readline().split()[-1]


def until(done: Callable[[], bool], step: Callable[[], None]) -> None:
    """Repeat ``step`` until it is ``done``."""
    end_s = time.monotonic() + PATIENCE_S
    while not done():
        if time.monotonic() > end_s:
            raise TimeoutError(f"nothing to draw within {PATIENCE_S:g} s")
        step()


def heard_by_ros(done: Callable[[Picture], bool]) -> Picture:
    """What a ROS node hears until it is enough."""
    picture = Picture()
    rclpy.init()
    node = rclpy.create_node("live_pictures")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for topic, kind, qos in (
        (topics.VIZ_MAP, MarkerArray, latched),
        (topics.VIZ_MARKERS, MarkerArray, 10),
        (PATH_TOPIC, PathMsg, 10),
    ):
        node.create_subscription(kind, topic, lambda m, topic=topic: picture.take(topic, m), qos)
    until(lambda: done(picture), lambda: rclpy.spin_once(node, timeout_sec=0.1))
    rclpy.shutdown()
    return picture


def heard_by_websocket(url: str, done: Callable[[Picture], bool]) -> Picture:
    """What a client of live hears until it is enough."""
    picture = Picture()
    wanted = {topics.VIZ_MAP, topics.VIZ_MARKERS, PATH_TOPIC}
    with Viewer(url, lambda topic, _: topic in wanted) as viewer:

        def step() -> None:
            if received := viewer.receive(0.1):
                picture.take(received.topic, received.message)

        until(lambda: done(picture), step)
    return picture


def watched(url: str, seconds: float) -> RenderableType:
    """What the terminal shows after so long."""
    board = Board()
    end_s = time.monotonic() + seconds
    with Viewer(url, board.wants) as viewer:
        while time.monotonic() < end_s:
            if received := viewer.receive(0.1):
                now_s = time.monotonic()
                board.add(received.topic, received.message, received.log_time_ns, now_s)
    return screen(board, DEFAULT_URL, time.monotonic())


def yaw_of(marker: Any) -> float:
    q = marker.pose.orientation
    return float(yaw_from_quaternion(np.array([q.x, q.y, q.z, q.w])))


def colour_of(marker: Any) -> tuple[float, float, float, float]:
    c = marker.color
    return c.r, c.g, c.b, c.a


def arrow(marker: Any) -> Polygon:
    """From above."""
    length, width = marker.scale.x, marker.scale.y
    outline = np.array([[0.0, 0.5], [1.0, 0.0], [0.0, -0.5], [0.25, 0.0]]) * [length, width]
    yaw = yaw_of(marker)
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    position = [marker.pose.position.x, marker.pose.position.y]
    return Polygon(outline @ turn.T + position, color=colour_of(marker), lw=0, zorder=6)


def draw_marker(axes: Axes, marker: Any) -> None:
    """One marker from above, as RViz and Foxglove draw it."""
    position, scale, colour = marker.pose.position, marker.scale, colour_of(marker)
    if marker.type == Marker.CUBE:
        corner = (position.x - scale.x / 2, position.y - scale.y / 2)
        axes.add_patch(Rectangle(corner, scale.x, scale.y, color=colour, lw=0))
    elif marker.type == Marker.CYLINDER:
        degrees = math.degrees(yaw_of(marker))
        shape = Ellipse((position.x, position.y), scale.x, scale.y, angle=degrees)
        shape.set(color=colour, lw=0, zorder=4)
        axes.add_patch(shape)
    elif marker.type == Marker.LINE_STRIP:
        points = np.array([[p.x, p.y] for p in marker.points])
        axes.plot(*points.T, color=colour, lw=1.6, zorder=3)
    elif marker.type == Marker.ARROW:
        axes.add_patch(arrow(marker))
    elif marker.type == Marker.TEXT_VIEW_FACING:
        above = {"xytext": (0, 9), "textcoords": "offset points", "ha": "center"}
        axes.annotate(
            marker.text, (position.x, position.y), **above, color=colour, fontsize=8, zorder=7
        ).set_clip_on(True)


def draw(picture: Picture, half_width_m: float, title: str) -> Figure:
    """Map, devices and path around the first device."""
    figure = Figure(figsize=(7.5, 6.0), facecolor=BACKGROUND)
    axes = figure.add_subplot(facecolor=BACKGROUND)
    shown = [*picture.map.markers, *picture.markers.markers]
    for marker in shown:
        if marker.action == Marker.ADD:
            draw_marker(axes, marker)
    points = np.array([[p.pose.position.x, p.pose.position.y] for p in picture.path.poses])
    axes.plot(*points.T, color=PATH_COLOUR, lw=1.2, ls="--", zorder=2)
    device = next(m for m in shown if m.ns == "devices").pose.position
    axes.set_xlim(device.x - half_width_m, device.x + half_width_m)
    axes.set_ylim(device.y - 0.8 * half_width_m, device.y + 0.8 * half_width_m)
    axes.set_aspect("equal")
    axes.tick_params(colors="#BBBBBB", labelsize=8)
    axes.set_xlabel("east [m]", color="#BBBBBB")
    axes.set_ylabel("north [m]", color="#BBBBBB")
    axes.set_title(title, color="#DDDDDD", fontsize=9)
    return figure


def main() -> None:
    """Run both graphs, draw what they show."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs/pictures")
    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with running("metis_madrid", 4.0, 4.0) as url:
        wanted = {"devices", "ellipses", "protection levels", "lines of sight"}
        seen = heard_by_ros(
            lambda p: wanted <= p.groups and p.map is not None and _length(p.path) > 60.0
        )
        terminal = watched(url, 5.0)
    title = "metis_madrid: /viz/map, /viz/markers and /viz/vue_1/path"
    save(draw(seen, 62.0, title), folder / "live_markers.png")
    console = Console(record=True, width=STATUS_WIDTH, file=sys.stderr)
    console.print(terminal)
    drawn = FONTS.sub("", console.export_svg(title="netpos watch"))
    (folder / "live_watch.svg").write_text(drawn, encoding="utf-8")
    with running("pedestrian_rectangle", 0.5, 0.4) as url:
        seen = heard_by_websocket(
            url, lambda p: "modes" in p.groups and p.map is not None and p.path is not None
        )
    title = "pedestrian_rectangle by WebSocket: several places are possible"
    save(draw(seen, 7.0, title), folder / "live_modes.png")


def _length(path: Any) -> float:
    """Of a path [m]; 0 where there is none."""
    if path is None or len(path.poses) < 2:
        return 0.0
    points = np.array([[p.pose.position.x, p.pose.position.y] for p in path.poses])
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


if __name__ == "__main__":
    main()
