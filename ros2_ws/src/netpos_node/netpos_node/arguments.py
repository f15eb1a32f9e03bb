"""What stands on a node's command line: help, and what it would otherwise ignore in silence."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

from netpos.common.parameters import nearest
from netpos.common.yaml_text import YamlError, load_yaml
from rclpy.utilities import remove_ros_args

_OF_ROS = ("use_sim_time", "start_type_description_service")
_QOS = "qos_overrides."


def refuse(why: str) -> NoReturn:
    """End the process with one sentence and code 2."""
    print(f"error: {why}", file=sys.stderr)
    sys.exit(2)


def check_arguments(node: Any, arguments: Sequence[str]) -> None:
    """Tell the parameters of a node and end where ``--help`` is asked for; refuse arguments that
    are none, names of parameters that the node has not, and files of parameters for others."""
    own = remove_ros_args(["", *arguments])[1:]
    if {"-h", "--help"} & set(own):
        print(usage(node))
        sys.exit(0)
    if own:
        refuse(
            f"{own[0]!r} is no argument of {node.get_name()}; parameters are given as "
            "--ros-args -p NAME:=VALUE"
        )
    known = node.list_parameters([], 0).names
    for name in node._parameter_overrides:  # rclpy tells of them nowhere else
        if not (node.has_parameter(name) or name in _OF_ROS or name.startswith(_QOS)):
            refuse(f"{node.get_name()} has no parameter {name!r}{nearest(name, known)}")
    _check_files(node, arguments)


def usage(node: Any) -> str:
    """The parameters of a node, with their values as they stand and what they mean."""
    names = sorted(node.list_parameters([], 0).names)
    lines = [
        f"usage: {node.get_name()} --ros-args [-p NAME:=VALUE]... [--params-file FILE]",
        "",
        "parameters, as they stand:",
    ]
    for name in names:
        if name in _OF_ROS or name.startswith(_QOS):
            continue
        value = node.get_parameter(name).value
        text = node.describe_parameter(name).description
        lines.append(f"  {name}: {value!r}" + (f"\n      {text}" if text else ""))
    return "\n".join(lines)


def _check_files(node: Any, arguments: Sequence[str]) -> None:
    """A file of parameters that has none for this node is a mistake."""
    for flag, value in pairwise(arguments):
        if flag != "--params-file":
            continue
        try:
            content = load_yaml(Path(value).read_text(encoding="utf-8"))
        except YamlError as error:
            refuse(f"{value}: {error}")
        names = [str(name) for name in content] if isinstance(content, dict) else []
        mine = node.get_name()
        if not any("*" in name or name.rsplit("/", 1)[-1] == mine for name in names):
            refuse(f"{value} has parameters of {', '.join(names) or 'no node'}, none of {mine}")
