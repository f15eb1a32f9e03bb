"""The `ros2` stand-in against the real tracker: parameters, services, life, nodes, bags."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import PoseWithCovarianceStamped
from graph import LATCHED, Graph, wait_until
from netpos.messages.values import RsuInfo
from netpos_msgs.msg import RsuInfo as RsuInfoMessage
from netpos_node import CODEC
from runs import graphs

ROOT = Path(__file__).resolve().parents[1]
STANDIN = str(ROOT / "scripts" / "ros2_standin" / "ros2")
TRACKER = "/ekf_tracker"


@pytest.fixture(name="graph", scope="module")
def _graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    """A graph with a tracker in it."""
    with graphs(tmp_path_factory.mktemp("standin")) as (graph,):
        process = graph.run("ekf_tracker", "ekf_tracker")
        graph.wait_for_publishers("/vue_1/odometry")
        yield graph
        assert process.running, process.describe()


def ros2(graph: Graph, *arguments: str, code: int = 0) -> str:
    """Run one command of the stand-in to its end."""
    done = subprocess.run(
        [STANDIN, *arguments],
        env=graph.environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == code, f"{arguments}: {done.returncode}\n{done.stderr}"
    return done.stdout + done.stderr


def test_parameters(graph: Graph) -> None:
    assert "gate_probability" in ros2(graph, "param", "list", TRACKER).split()
    # What a list finds in its one second is not all on a busy machine, with the real ros2 neither.
    wait_until(lambda: "/ekf_tracker:\n" in ros2(graph, "param", "list"), "the tracker in a list")
    get = ("param", "get", TRACKER, "gate_probability")
    assert ros2(graph, *get) == "Double value is: 0.9999\n"
    assert "successful" in ros2(graph, "param", "set", TRACKER, "gate_probability", "0.99")
    assert ros2(graph, *get) == "Double value is: 0.99\n"
    refused = ros2(graph, "param", "set", TRACKER, "hold_s", "0.5", code=1)
    assert "hold_s cannot change while the tracker is configured" in refused
    told = ros2(graph, "param", "describe", TRACKER, "gate_probability")
    assert "  Type: double\n" in told
    assert "Min value: 0.5\n    Max value: 1.0\n" in told
    assert "chi-square" in told


def test_dumped_parameters_start_a_tracker(graph: Graph, tmp_path: Path) -> None:
    file = tmp_path / "dumped.yaml"
    file.write_text(ros2(graph, "param", "dump", TRACKER), encoding="utf-8")
    values = yaml.safe_load(file.read_text(encoding="utf-8"))[TRACKER]["ros__parameters"]
    assert values["vues"] == ["vue_1"]
    with graphs(tmp_path / "other") as (other,):
        command = ["ros2", "run", "ekf_tracker", "ekf_tracker", "--ros-args"]
        other.start("ekf_tracker", [*command, "--params-file", str(file)])
        other.wait_for_publishers("/vue_1/odometry")


def test_nodes_topics_and_services(graph: Graph) -> None:
    told = ros2(graph, "node", "info", TRACKER)
    for line in (
        "  Subscribers:\n",
        "    /rsu/measurements: netpos_msgs/msg/RsuMeasurement\n",
        "    /vue_1/odometry: nav_msgs/msg/Odometry\n",
        "    /ekf_tracker/reset: std_srvs/srv/Trigger\n",
    ):
        assert line in told
    assert "Node not found: /nobody" in ros2(graph, "node", "info", "/nobody", code=1)
    assert ros2(graph, "topic", "type", "/vue_1/odometry") == "nav_msgs/msg/Odometry\n"
    info = ros2(graph, "topic", "info", "-v", "/rsu/info")
    assert "Publisher count: 0" in info
    assert "Subscription count: 1" in info
    assert "Node name: ekf_tracker\n" in info
    assert "  Durability: TRANSIENT_LOCAL\n" in info
    assert "Unknown topic" in ros2(graph, "topic", "type", "/nothing", code=1)
    listed = ros2(graph, "service", "list", "-t")
    assert "/ekf_tracker/enable [std_srvs/srv/SetBool]\n" in listed
    answer = ros2(
        graph, "service", "call", "/ekf_tracker/enable", "std_srvs/srv/SetBool", "{data: false}"
    )
    assert "disabled: measurements are refused" in answer
    answer = ros2(graph, "service", "call", "/ekf_tracker/enable", "std_srvs/srv/SetBool",
                  "{data: true}")  # fmt: skip
    assert "message='enabled'" in answer
    wrong = ros2(graph, "service", "call", "/ekf_tracker/enable", "std_srvs/srv/SetBool",
                 "{what: 1}", code=1)  # fmt: skip
    assert "no field 'what'; there are data" in wrong


def test_pub_and_echo_of_a_field(graph: Graph) -> None:
    """A pose typed by hand arrives field by field, covariance included."""
    heard = graph.collect("/typed/initialpose", PoseWithCovarianceStamped)
    covariance = [0.0] * 36
    covariance[0] = 4.0
    values = {
        "header": {"frame_id": "map", "stamp": {"sec": 3}},
        "pose": {"pose": {"position": {"x": 1, "y": 2.5}}, "covariance": covariance},
    }
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    told = ros2(
        graph, "topic", "pub", "--once", "/typed/initialpose", kind, yaml.safe_dump(values)
    )
    assert "publishing #1:" in told
    (message,) = heard.wait_for(1)
    assert (message.header.frame_id, message.header.stamp.sec) == ("map", 3)
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == (1.0, 2.5)
    assert list(message.pose.covariance) == covariance

    info = RsuInfo(rsu_id="a0", position=np.array([1.0, 2.0, 3.5]))
    graph.publisher("/other/info", RsuInfoMessage, LATCHED).publish(CODEC.rsu_info_to_msg(info))
    echo = ("topic", "echo", "--once", "/other/info", "--field")
    assert ros2(graph, *echo, "pose.position.z") == "3.5\n---\n"
    assert ros2(graph, *echo, "rsu_id") == "a0\n---\n"
    assert "no field 'pose.q'" in ros2(graph, *echo, "pose.q", code=1)
    other = ros2(graph, "topic", "echo", "--once", "/other/info", "std_msgs/msg/String", code=1)
    assert "/other/info has the type netpos_msgs/msg/RsuInfo, not std_msgs/msg/String" in other
    unread = f"{STANDIN} topic echo --once /other/info | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", unread], env=graph.environment, capture_output=True,
                          text=True, timeout=60, check=True)  # fmt: skip
    assert (done.stdout, done.stderr) == ("1\n", "")


def test_bandwidth(graph: Graph) -> None:
    publisher = graph.publisher("/wide", PoseWithCovarianceStamped)
    timer = graph.node.create_timer(0.02, lambda: publisher.publish(PoseWithCovarianceStamped()))
    process = graph.start("bw", [STANDIN, "topic", "bw", "/wide"])
    process.wait_for_output("KB/s from ")
    process.wait_for_output("Message size mean: ")
    assert process.interrupt() == 130
    timer.cancel()
    assert "Traceback" not in process.output


def test_life(graph: Graph) -> None:
    get = ("lifecycle", "get", TRACKER)
    assert ros2(graph, *get) == "active [3]\n"
    assert "successful" in ros2(graph, "lifecycle", "set", TRACKER, "deactivate")
    assert ros2(graph, *get) == "inactive [2]\n"
    wait_until(lambda: graph.node.count_subscribers("/rsu/measurements") == 0, "silence")
    wrong = ros2(graph, "lifecycle", "set", TRACKER, "configure", code=1)
    assert "available ones are: " in wrong
    assert "successful" in ros2(graph, "lifecycle", "set", TRACKER, "activate")
    graph.wait_for_subscribers("/rsu/measurements")


def test_bags(graph: Graph, tmp_path: Path) -> None:
    """Record as the real command is called, look into the bag, play it."""
    bag = tmp_path / "bag"
    process = graph.start("record", [STANDIN, "bag", "record", "-o", str(bag), "/recorded/info"])
    process.wait_for_output("recording to")
    info = RsuInfo(rsu_id="a0", position=np.zeros(3))
    publisher = graph.publisher("/recorded/info", RsuInfoMessage, LATCHED)
    graph.wait_for_subscribers("/recorded/info")
    for _ in range(3):
        publisher.publish(CODEC.rsu_info_to_msg(info))
    wait_until(lambda: any(bag.glob("*.mcap")), "the bag")
    assert process.interrupt() == 0
    told = ros2(graph, "bag", "info", str(bag))
    assert "Topic: /recorded/info | Type: netpos_msgs/msg/RsuInfo | Count: 3 |" in told
    assert "Storage id:        mcap\n" in told
    process = graph.start("play", [STANDIN, "bag", "play", str(bag), "-r", "10"])
    process.wait_for_output("/recorded/info: 3")
    assert process.wait() == 0
    assert "no_such" in ros2(graph, "bag", "info", str(tmp_path / "no_such"), code=1)


def test_interfaces(graph: Graph) -> None:
    listed = ros2(graph, "interface", "list")
    assert "    netpos_msgs/msg/RsuMeasurement\n" in listed
    assert "    std_srvs/srv/Trigger\n" in listed
    assert "srv" not in ros2(graph, "interface", "list", "-m")
    assert "---" in ros2(graph, "interface", "show", "std_srvs/srv/Trigger")
