"""What a node is started with and cannot use is an error, not a silent start."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from netpos_node import declare
from netpos_node.arguments import check_arguments
from rclpy.node import Node
from rclpy.parameter import Parameter


@pytest.fixture(name="node")
def _node() -> Iterator[Any]:
    rclpy.init()
    made: list[Node] = []

    def make(**overrides: Any) -> Node:
        given = [Parameter(name, value=value) for name, value in overrides.items()]
        node = Node("some_node", parameter_overrides=given)
        declare(node, "hold_s", 0.1, "how long to wait")
        declare(node, "vues", ["a"], "devices")
        made.append(node)
        return node

    yield make
    for node in made:
        node.destroy_node()
    rclpy.shutdown()


def refused(capsys: Any, node: Node, *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        check_arguments(node, arguments)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return str(said)


def test_a_misspelt_parameter_names_the_nearest(node: Any, capsys: Any) -> None:
    said = refused(capsys, node(hold=1.0), "--ros-args", "-p", "hold:=1.0")
    assert said == "error: some_node has no parameter 'hold'; did you mean hold_s?\n"


def test_an_argument_that_is_none(node: Any, capsys: Any) -> None:
    said = refused(capsys, node(), "--hold", "3", "--ros-args", "-p", "hold_s:=1.0")
    assert "'--hold' is no argument of some_node; parameters are given as --ros-args -p" in said


def test_a_file_of_parameters_for_another_node(node: Any, capsys: Any, tmp_path: Path) -> None:
    file = tmp_path / "params.yaml"
    file.write_text("other_node:\n  ros__parameters:\n    hold_s: 1.0\n")
    said = refused(capsys, node(), "--ros-args", "--params-file", str(file))
    assert said == f"error: {file} has parameters of other_node, none of some_node\n"


@pytest.mark.parametrize("name", ["/**", "some_node", "/room/some_node", "*"])
def test_what_is_meant_for_the_node_passes(node: Any, tmp_path: Path, name: str) -> None:
    file = tmp_path / "params.yaml"
    file.write_text(f"'{name}':\n  ros__parameters:\n    hold_s: 1.0\n")
    arguments = ["--ros-args", "-p", "hold_s:=1.0", "--params-file", str(file), "-r", "a:=b"]
    check_arguments(node(hold_s=1.0, use_sim_time=True), arguments)


@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help_tells_the_parameters(node: Any, capsys: Any, flag: str) -> None:
    with pytest.raises(SystemExit) as ended:
        check_arguments(node(hold_s=0.5), [flag])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    assert "usage: some_node --ros-args [-p NAME:=VALUE]" in said
    assert "  hold_s: 0.5\n      how long to wait\n  vues: ['a']" in said
    assert "use_sim_time" not in said
