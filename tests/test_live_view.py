"""A running METIS seen by viz, live and netpos watch."""

from __future__ import annotations

import json
import re
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from graph import LATCHED, Collector, Graph, Process, wait_until
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMsg
from netpos.bench.domains import claim_domain
from netpos.messages.fields import stamp_ns
from netpos.scenario import load_scenario
from netpos.scenario.build import buildings_of
from netpos_msgs.msg import TrackStatus
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from runs import RUN_S, graphs
from scipy.stats import chi2
from visualization_msgs.msg import Marker, MarkerArray
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

SCENARIO = "metis_madrid"
SILENT_S = 2.0
PROTOCOL = [Subprotocol("foxglove.sdk.v1")]


@dataclass
class Seen:
    """The running graph, what is heard of it, and where it is served."""

    graph: Graph
    simulator: Process
    url: str
    odometry: Collector
    status: Collector
    markers: Collector
    path: Collector


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Seen]:
    with graphs(tmp_path_factory.mktemp("live_view")) as (graph,):
        kinds = {
            "/vue_1/odometry": Odometry,
            "/vue_1/track_status": TrackStatus,
            "/viz/markers": MarkerArray,
            "/viz/vue_1/path": PathMsg,
        }
        heard = [graph.collect(topic, kind) for topic, kind in kinds.items()]
        scenario = {"scenario": SCENARIO}
        graph.run("netpos_bringup", "viz", parameters={"silent_s": SILENT_S, "rate_hz": 10.0})
        server = graph.run("netpos_bringup", "live", "--port", "0")
        graph.run("ekf_tracker", "ekf_tracker", parameters=scenario)
        graph.run("rsu_sensor", "rsu_sensor", parameters=scenario | {"subscribers": 1})
        graph.wait_for_nodes("ekf_tracker", "rsu_sensor", "viz", "netpos_live")
        simulator = graph.run(
            "vue_sim", "vue_sim", parameters=scenario | {"subscribers": 1, "rate": 0.5}
        )
        server.wait_for_output("serving ROS domain")
        url = server.output.split()[-1]
        heard[2].wait_for(30, RUN_S)
        heard[3].wait_for(2, RUN_S)
        yield Seen(graph, simulator, url, *heard)


def devices(frame: Any) -> list[Any]:
    return [m for m in frame.markers if m.ns == "devices" and m.action == Marker.ADD]


def drawn(seen: Seen, also: str = "devices") -> list[Any]:
    """Ten frames or more that show the device and markers of ``also``, once there are so many."""

    def found() -> list[Any]:
        frames = [frame for frame in list(seen.markers.messages) if devices(frame)]
        frames = [frame for frame in frames if any(m.ns == also for m in frame.markers)]
        return frames if len(frames) >= 10 else []

    return list(wait_until(found, f"ten frames with {also}"))


def test_the_map_comes_to_who_is_late(seen: Seen) -> None:
    """Every RSU and every building of the scenario, to a subscriber of now."""
    late = seen.graph.collect("/viz/map", MarkerArray, LATCHED)

    def whole() -> Any:
        frame = late.messages[-1] if late.messages else MarkerArray()
        groups = [m.ns for m in frame.markers]
        return frame if groups.count("rsus") == 100 and "buildings" in groups else None

    frame = wait_until(whole, "a map with all RSUs")
    buildings = {
        (m.pose.position.x, m.pose.position.y, m.scale.x, m.scale.y)
        for m in frame.markers
        if m.ns == "buildings"
    }
    wanted = buildings_of(load_scenario(SCENARIO))
    low, high = wanted[:, :2], wanted[:, 2:]
    expected = np.hstack([(low + high) / 2, high - low])
    assert buildings == set(map(tuple, expected.tolist()))
    assert frame.markers[0].action == Marker.DELETEALL
    assert {m.header.frame_id for m in frame.markers} == {"map"}


def test_markers_are_where_the_estimate_is(seen: Seen) -> None:
    """The device and its ellipse, with the odometry of the same position as oracle."""
    frames = drawn(seen)
    shown = {(d.pose.position.x, d.pose.position.y) for f in frames for d in devices(f)}

    def estimates_shown() -> dict[tuple[float, float], Any]:
        estimates = {
            (o.pose.pose.position.x, o.pose.pose.position.y): np.reshape(o.pose.covariance, (6, 6))
            for o in list(seen.odometry.messages)
        }
        return estimates if shown <= estimates.keys() else {}

    estimates = wait_until(estimates_shown, "the odometry behind the markers")
    compared = 0
    for frame in frames:
        (device,) = devices(frame)
        cov = estimates[device.pose.position.x, device.pose.position.y]
        (ellipse,) = [m for m in frame.markers if m.ns == "ellipses"]
        semi = np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[::-1] * chi2.ppf(0.95, 2))
        assert [ellipse.scale.x, ellipse.scale.y] == pytest.approx(list(2 * semi), rel=1e-6)
        compared += 1
    assert compared >= 10


def test_a_marker_keeps_its_number_and_lives_for_a_while(seen: Seen) -> None:
    frames = drawn(seen)
    assert {marker.id for frame in frames for marker in devices(frame)} == {0}
    for frame in frames:
        for marker in frame.markers:
            limited = marker.lifetime.sec > 0 or marker.action == Marker.DELETE
            assert limited, marker.ns


def test_levels_and_lines_of_sight_are_those_of_the_status(seen: Seen) -> None:
    rings = [
        [np.hypot(p.x - device.pose.position.x, p.y - device.pose.position.y) for p in ring.points]
        for frame in drawn(seen)
        for device in devices(frame)
        for ring in frame.markers
        if ring.ns == "protection levels"
    ]
    assert len(rings) >= 10
    for radii in rings:
        assert radii == pytest.approx([radii[0]] * len(radii))

    def all_are_levels() -> bool:
        levels = np.array([s.protection_level for s in list(seen.status.messages)])
        return all(np.abs(levels - radii[0]).min() < 1e-6 for radii in rings)

    wait_until(all_are_levels, "the statuses behind the rings")
    for frame in drawn(seen, "lines of sight")[-5:]:
        (device,) = devices(frame)
        for line in (m for m in frame.markers if m.ns == "lines of sight" and not m.action):
            assert line.points[1] == device.pose.position


def test_the_path_goes_through_estimates(seen: Seen) -> None:
    seen.path.wait_for(2)
    path = seen.path.messages[-1]
    points = [(stamp_ns(p.header.stamp), p.pose.position.x, p.pose.position.y) for p in path.poses]
    assert len(points) >= 2

    def all_are_estimates() -> bool:
        return set(points) <= {
            (stamp_ns(o.header.stamp), o.pose.pose.position.x, o.pose.pose.position.y)
            for o in list(seen.odometry.messages)
        }

    wait_until(all_are_estimates, "the odometry behind the path")
    assert points == sorted(points)
    assert path.header.frame_id == "map"


class Client:
    """The protocol in its simplest form, independent of the library's client."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.frames: dict[int, list[tuple[int, bytes]]] = {}

    def read(self, seconds: float = 0.2) -> None:
        try:
            frame = self.connection.recv(timeout=seconds)
        except TimeoutError:
            return
        if isinstance(frame, str):
            said = json.loads(frame)
            if said["op"] == "serverInfo":
                self.info = said
            elif said["op"] == "advertise":
                self.channels |= {entry["topic"]: entry for entry in said["channels"]}
        elif frame[0] == 1:
            number, time_ns = struct.unpack_from("<IQ", frame, 1)
            self.frames.setdefault(number, []).append((time_ns, frame[13:]))

    def advertised(self, *topics: str) -> None:
        def all_there() -> bool:
            self.read()
            return set(topics) <= self.channels.keys()

        wait_until(all_there, f"channels {topics}")

    def messages(self, topic: str, count: int) -> list[tuple[int, bytes]]:
        """Subscribe, and wait for so many messages."""
        self.advertised(topic)
        number = self.channels[topic]["id"]
        ask = {"op": "subscribe", "subscriptions": [{"id": number, "channelId": number}]}
        self.connection.send(json.dumps(ask))

        def enough() -> bool:
            self.read()
            return len(self.frames.get(number, [])) >= count

        wait_until(enough, f"{count} messages of {topic}", 30.0)
        return self.frames[number]


@pytest.fixture
def client(seen: Seen) -> Iterator[Client]:
    with connect(seen.url, subprotocols=PROTOCOL, max_size=None) as connection:
        yield Client(connection)


def test_every_topic_is_served_with_its_type(seen: Seen, client: Client) -> None:
    published = {
        topic: types[0]
        for topic, types in seen.graph.node.get_topic_names_and_types()
        if seen.graph.node.count_publishers(topic)
    }
    client.advertised(*published)
    assert {"/tf", "/diagnostics", "/rsu/measurements", "/viz/vue_1/path"} <= published.keys()
    for topic, type_name in published.items():
        channel = client.channels[topic]
        assert (channel["schemaName"], channel["encoding"]) == (type_name, "cdr"), topic
        assert channel["schemaEncoding"] == "ros2msg"
    assert client.info["capabilities"] == ["time"]  # nobody publishes or calls from there


def test_an_odometry_is_decoded_by_the_schema_that_is_served(seen: Seen, client: Client) -> None:
    before = {o.header.stamp.nanosec for o in list(seen.odometry.messages)}
    received = client.messages("/vue_1/odometry", 5)
    channel = client.channels["/vue_1/odometry"]
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
    for time_ns, cdr in received:
        read: Any = store.deserialize_cdr(cdr, channel["schemaName"])
        assert read.header.frame_id == "map"
        ns = stamp_ns(read.header.stamp)

        def same(ns: int = ns) -> Any:
            return next(
                (o for o in list(seen.odometry.messages) if stamp_ns(o.header.stamp) == ns), None
            )

        heard = wait_until(same, f"the odometry of {ns}")
        assert read.pose.pose.position.x == heard.pose.pose.position.x
        assert list(read.pose.covariance) == list(heard.pose.covariance)
        assert abs(time_ns - ns) < 30e9  # network time, not the system's
        assert read.header.stamp.nanosec not in before


def test_markers_and_measurements_are_served(client: Client) -> None:
    for topic in ("/viz/markers", "/rsu/measurements", "/tf", "/viz/vue_1/path", "/diagnostics"):
        client.messages(topic, 1)


def test_what_is_latched_comes_to_every_viewer(seen: Seen) -> None:
    """The second one while the first one is still there."""
    with connect(seen.url, subprotocols=PROTOCOL) as first:
        names = [len(Client(first).messages("/rsu/info", 100))]
        with connect(seen.url, subprotocols=PROTOCOL) as second:
            other = Client(second)
            names.append(len(other.messages("/rsu/info", 100)))
            other.messages("/run/scenario", 1)
            other.messages("/viz/map", 1)
    assert min(names) >= 100


def watch(seen: Seen, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["netpos", "watch", *arguments],
        capture_output=True,
        text=True,
        timeout=RUN_S,
        check=False,
        env=seen.graph.environment | {"COLUMNS": "150"},
    )


@pytest.mark.parametrize("address", [True, False], ids=["of live", "its own server"])
def test_watch_once(seen: Seen, address: bool) -> None:
    done = watch(seen, *([seen.url] if address else []), "--once", "--wait", "60")
    assert done.returncode == 0, done.stderr
    (row,) = re.findall(r"│ vue_1 .*", done.stdout)
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells[1].startswith(("TRACKING", "INITIALISING", "COASTING", "AMBIGUOUS"))
    x, y, _ = (float(text) for text in cells[3].split(","))
    near = [
        np.hypot(o.pose.pose.position.x - x, o.pose.pose.position.y - y)
        for o in list(seen.odometry.messages)
    ]
    assert min(near) < 0.01
    assert re.search(r"│ ok +│ rsus +│ 100 RSUs known", done.stdout)
    assert "100 RSUs" in done.stdout.splitlines()[0]


def test_watch_until_ctrl_c(seen: Seen) -> None:
    watching = seen.graph.start("watch", ["netpos", "watch", seen.url, "--period", "0.3"])
    wait_until(lambda: watching.output.count("vue_1") >= 3, "three frames", RUN_S)
    assert watching.interrupt() == 130
    assert watching.output.splitlines()[-1] == "netpos: interrupted"


def test_watch_in_a_domain_without_a_tracker(seen: Seen) -> None:
    with claim_domain() as domain:
        environment = seen.graph.environment | {"ROS_DOMAIN_ID": str(domain)}
        done = subprocess.run(
            ["netpos", "watch", "--once", "--wait", "2"],
            capture_output=True,
            text=True,
            timeout=RUN_S,
            check=False,
            env=environment,
        )
    assert done.returncode == 1
    assert "no device heard" in done.stdout
    assert "is a tracker running in its ROS domain?" in done.stderr


def test_a_silent_device_vanishes(seen: Seen) -> None:
    """Last of all: it ends the run."""
    begun = len(seen.markers.messages)
    seen.simulator.interrupt()

    def deleted() -> list[Any]:
        return [
            m
            for frame in seen.markers.messages[begun:]
            for m in frame.markers
            if m.ns == "devices" and m.action == Marker.DELETE
        ]

    (gone, *_) = wait_until(deleted, "the deletion of the device", 60.0)
    assert gone.id == 0
    wait_until(lambda: not seen.markers.messages[-1].markers, "frames without a device")
