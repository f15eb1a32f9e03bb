"""The `ros2` stand-in: starting executables, saying what there is, looking into the graph."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
import yaml
from geometry_msgs.msg import PointStamped
from graph import LATCHED, Graph, Process, wait_until


@pytest.fixture
def standin(repository: Path) -> str:
    return str(repository / "scripts" / "ros2_standin" / "ros2")


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """An install prefix with one package and three files beside it, two of them executable."""
    folder = tmp_path / "prefix"
    index = folder / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "toolbox").touch()
    programs = folder / "lib/toolbox"
    programs.mkdir(parents=True)
    (programs / "echo_arguments").write_text('#!/bin/sh\nprintf "%s|" "$@"\nexit 7\n')
    (programs / "own_pid").write_text("#!/bin/sh\necho $$\n")
    (programs / "notes.txt").write_text("not a program\n")
    for name in ("echo_arguments", "own_pid"):
        (programs / name).chmod(0o755)
    return folder


def ask(standin: str, prefix: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "AMENT_PREFIX_PATH": f"/nowhere:{prefix}"}
    return subprocess.run(
        [standin, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=30,
    )


def test_run_passes_arguments_and_exit_code(standin: str, prefix: Path) -> None:
    result = ask(standin, prefix, "run", "toolbox", "echo_arguments", "a b", "--ros-args", "x:=''")
    assert result.stdout == "a b|--ros-args|x:=''|"
    assert result.returncode == 7


def test_run_becomes_the_program(standin: str, prefix: Path) -> None:
    """So that signals sent to `ros2 run` reach the node."""
    environment = {**os.environ, "AMENT_PREFIX_PATH": str(prefix)}
    command = [standin, "run", "toolbox", "own_pid"]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    assert int(process.communicate(timeout=30)[0]) == process.pid


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["run", "tool", "own_pid"], 1, "package 'tool' not found"),
        (["run", "toolbox", "own"], 1, "it has: echo_arguments own_pid"),
        (["run", "toolbox", "notes.txt"], 1, "no executable 'notes.txt'"),
        (["pkg", "executables", "tool"], 1, "package 'tool' not found"),
        (["interface", "show", "toolbox/msg/Hammer"], 1, "toolbox/msg/Hammer"),
        (["run", "toolbox"], 2, "usage:"),
        (["bag", "copy"], 2, "usage:"),
        (["bag", "record", "--frobnicate"], 2, "usage:"),
        (["launch", "a"], 2, "usage:"),
        ([], 2, "usage:"),
    ],
)
def test_errors_say_what_there_is(
    standin: str, prefix: Path, arguments: list[str], code: int, said: str
) -> None:
    result = ask(standin, prefix, *arguments)
    assert result.returncode == code
    assert result.stdout == ""
    assert said in result.stderr


def test_packages_and_executables_are_listed(standin: str, prefix: Path) -> None:
    assert ask(standin, prefix, "pkg", "list").stdout == "toolbox\n"
    assert ask(standin, prefix, "pkg", "prefix", "toolbox").stdout == f"{prefix}\n"
    for arguments in ([], ["toolbox"]):
        listed = ask(standin, prefix, "pkg", "executables", *arguments).stdout
        assert listed == "toolbox echo_arguments\ntoolbox own_pid\n"


def test_interface_is_shown(standin: str) -> None:
    command = [standin, "interface", "show", "geometry_msgs/msg/Point"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout
    assert [line for line in shown.splitlines() if line.startswith("float64")] == [
        f"float64 {axis}" for axis in "xyz"
    ]


# ---- with a publisher in the graph ----


def finish(process: Process) -> str:
    assert process.wait() == 0, process.describe()
    return process.output


def test_lists_name_topics_and_nodes(standin: str, graph: Graph) -> None:
    """Asked again until discovery was quick enough: the lists wait for it a second only."""
    graph.publisher("/here", PointStamped)

    def listed(*command: str) -> list[str]:
        return finish(graph.start("list", [standin, *command])).splitlines()

    wait_until(
        lambda: "/here [geometry_msgs/msg/PointStamped]" in listed("topic", "list", "-t"),
        "the topic",
    )
    wait_until(lambda: listed("node", "list") == ["/test_observer"], "the node")


def test_echo_prints_a_latched_message(standin: str, graph: Graph) -> None:
    """A message published before `echo` started is received, as its publisher offers it."""
    message = PointStamped()
    message.header.frame_id = "map"
    message.point.x = 1.5
    graph.publisher("/here", PointStamped, LATCHED).publish(message)
    shown = finish(graph.start("echo", [standin, "topic", "echo", "--once", "here"]))
    (document, _) = yaml.safe_load_all(shown)
    assert document == {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "map"},
        "point": {"x": 1.5, "y": 0.0, "z": 0.0},
    }


def test_hz_reports_a_rate_until_interrupted(standin: str, graph: Graph) -> None:
    publisher = graph.publisher("/here", PointStamped)
    timer = graph.node.create_timer(0.02, lambda: publisher.publish(PointStamped()))
    process = graph.start("hz", [standin, "topic", "hz", "/here"])
    process.wait_for_output("average rate: ")
    assert process.interrupt() == 130
    timer.cancel()
    assert "Traceback" not in process.output


def test_echo_waits_for_a_publisher(standin: str, graph: Graph) -> None:
    process = graph.start("echo", [standin, "topic", "echo", "--once", "/late"])
    process.wait_for_output("nobody publishes /late yet")
    publisher = graph.publisher("/late", PointStamped)
    wait_until(lambda: publisher.get_subscription_count() > 0, "the subscription of echo")
    publisher.publish(PointStamped())
    assert "frame_id" in finish(process)
