"""The commands of ros2cli against a running tracker and one of our bags: the real `ros2` where it
is installed, and the stand-in. What is asserted here holds for both.

The wheels have no ros2cli. In the image of docker/Dockerfile it is there:
    docker run --rm -v "$PWD/tests:/netpos/tests:ro" netpos \
        python -m pytest -q tests/test_ros2_commands.py
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import netpos
import numpy as np
import pytest
import yaml
from graph import LATCHED, Graph, wait_until
from netpos_msgs.msg import RsuInfo as RsuInfoMessage
from netpos_node import CODEC
from runs import graphs

ROOT = Path(__file__).resolve().parents[1]
STANDIN = (str(ROOT / "scripts" / "ros2_standin" / "ros2"),)
# As the command `ros2` starts it, wherever PATH leads.
REAL = (sys.executable, "-c", "import sys, ros2cli.cli; sys.exit(ros2cli.cli.main())")
NEEDED = ("ros2cli", "ros2topic", "ros2node", "ros2param", "ros2service", "ros2lifecycle")
TRACKER = "/ekf_tracker"
INFO = netpos.RsuInfo(rsu_id="a0", position=np.array([1.0, 2.0, 3.5]))

Answer = Callable[..., str]


@pytest.fixture(name="graph", scope="module")
def _graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    """A graph with a tracker and one RSU in it."""
    with graphs(tmp_path_factory.mktemp("commands")) as (graph,):
        process = graph.run("ekf_tracker", "ekf_tracker")
        graph.wait_for_publishers("/vue_1/odometry")
        graph.publisher("/rsu/info", RsuInfoMessage, LATCHED).publish(CODEC.rsu_info_to_msg(INFO))
        yield graph
        assert process.running, process.describe()


@pytest.fixture(name="ros2", scope="module", params=["real", "stand-in"])
def _ros2(graph: Graph, request: pytest.FixtureRequest) -> Iterator[Answer]:
    """Runs a command until its output has all of some texts: discovery takes a moment."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if request.param == "real" and missing:
        pytest.skip(
            f"the real ros2 is not here ({', '.join(missing)} cannot be imported): the ROS wheels "
            "do not have it; source a Jazzy installation, or run this test in the Docker image"
        )
    command = REAL if request.param == "real" else STANDIN

    def run(*arguments: str) -> str:
        done = subprocess.run(
            [*command, *arguments],
            env=graph.environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        return done.stdout + done.stderr

    def answer(*arguments: str, has: tuple[str, ...]) -> str:
        told = ""

        def complete() -> bool:
            nonlocal told
            told = run(*arguments)
            return all(text in told for text in has)

        try:
            wait_until(complete, "", timeout_s=30.0)
        except TimeoutError:
            pytest.fail(f"ros2 {' '.join(arguments)}: not all of {has} in:\n{told}")
        return told

    yield answer
    if request.param == "real":
        run("daemon", "stop")


def test_topics(ros2: Answer) -> None:
    listed = ros2("topic", "list", has=("/rsu/info\n", "/vue_1/odometry\n"))
    assert "/rsu/measurements" in listed.splitlines()
    ros2("topic", "info", "/rsu/info", has=("Type: netpos_msgs/msg/RsuInfo\n",
         "Publisher count: 1\n", "Subscription count: 1\n"))  # fmt: skip
    ros2("topic", "type", "/vue_1/odometry", has=("nav_msgs/msg/Odometry\n",))


def test_echo(ros2: Answer) -> None:
    """A latched message of our own type, whole and one field of it."""
    told = ros2("topic", "echo", "--once", "/rsu/info", has=("rsu_id: a0\n", "---\n"))
    message = yaml.safe_load(told.partition("---\n")[0])
    assert message["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 3.5}
    assert message["header"]["frame_id"] == "map"
    typed = ("/rsu/info", "netpos_msgs/msg/RsuInfo", "--field", "pose.position.z")
    ros2("topic", "echo", "--once", *typed, has=("3.5\n---\n",))


def test_nodes(ros2: Answer) -> None:
    assert TRACKER in ros2("node", "list", has=(f"{TRACKER}\n",)).splitlines()
    ros2("node", "info", TRACKER, has=(
        "  Subscribers:\n",
        "    /rsu/measurements: netpos_msgs/msg/RsuMeasurement\n",
        "    /vue_1/odometry: nav_msgs/msg/Odometry\n",
        "    /ekf_tracker/reset: std_srvs/srv/Trigger\n",
    ))  # fmt: skip


def test_parameters(ros2: Answer) -> None:
    """A safe one changes, one that shapes the tracks is refused with the reason."""
    name = "gate_probability"
    ros2("param", "list", TRACKER, has=(name, "hold_s"))
    ros2("param", "get", TRACKER, name, has=("Double value is: ",))
    ros2("param", "set", TRACKER, name, "0.99", has=("Set parameter successful",))
    ros2("param", "get", TRACKER, name, has=("Double value is: 0.99\n",))
    ros2("param", "set", TRACKER, name, "0.9999", has=("Set parameter successful",))
    ros2("param", "set", TRACKER, "hold_s", "0.5",
         has=("hold_s cannot change while the tracker is configured",))  # fmt: skip


def test_a_service(ros2: Answer) -> None:
    call = ("service", "call", "/ekf_tracker/enable", "std_srvs/srv/SetBool")
    ros2(*call, "{data: false}", has=("success=True", "disabled: measurements are refused"))
    ros2(*call, "{data: true}", has=("success=True", "message='enabled'"))


def test_life(ros2: Answer) -> None:
    get = ("lifecycle", "get", TRACKER)
    ros2(*get, has=("active [3]\n",))
    ros2("lifecycle", "set", TRACKER, "deactivate", has=("Transitioning successful",))
    ros2(*get, has=("inactive [2]\n",))
    ros2("lifecycle", "set", TRACKER, "activate", has=("Transitioning successful",))
    ros2(*get, has=("active [3]\n",))


def test_a_bag(ros2: Answer, tmp_path: Path) -> None:
    kind = netpos.RsuMeasurement
    measured = [
        kind(stamp_ns=k * 10**8, rsu_id="a0", vue_id="tag", fields=kind.RANGE,
             range_m=5.0, range_var=0.01)
        for k in range(1, 6)
    ]  # fmt: skip
    bag = netpos.write_bag(tmp_path / "walk", rsus=[INFO], measurements=measured)
    ros2("bag", "info", str(bag.path), has=(
        "Topic: /rsu/info | Type: netpos_msgs/msg/RsuInfo | Count: 1 |",
        "Topic: /rsu/measurements | Type: netpos_msgs/msg/RsuMeasurement | Count: 5 |",
        "Messages:          6\n",
    ))  # fmt: skip
