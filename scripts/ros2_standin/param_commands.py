"""`ros2 param list | get | set | describe | dump`."""

from __future__ import annotations

import argparse
from typing import Any

import yaml
from rcl_interfaces.msg import Parameter, ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from shared import CommandError, as_plain, call, find_node, full_name, nodes, wait_for_discovery

_TYPES = {
    ParameterType.PARAMETER_BOOL: "Boolean",
    ParameterType.PARAMETER_INTEGER: "Integer",
    ParameterType.PARAMETER_DOUBLE: "Double",
    ParameterType.PARAMETER_STRING: "String",
    ParameterType.PARAMETER_BYTE_ARRAY: "Byte values",
    ParameterType.PARAMETER_BOOL_ARRAY: "Boolean values",
    ParameterType.PARAMETER_INTEGER_ARRAY: "Integer values",
    ParameterType.PARAMETER_DOUBLE_ARRAY: "Double values",
    ParameterType.PARAMETER_STRING_ARRAY: "String values",
}


def add_parsers(commands: Any) -> None:
    """Declare `ros2 param ...`."""
    param = commands.add_parser("param").add_subparsers(dest="verb", required=True)
    listing = param.add_parser("list")
    listing.add_argument("node", nargs="?")
    listing.set_defaults(run=list_parameters)
    dump = param.add_parser("dump")
    dump.add_argument("node")
    dump.set_defaults(run=dump_parameters)
    for verb, run in (("get", get), ("describe", describe), ("set", set_parameter)):
        one = param.add_parser(verb)
        one.add_argument("node")
        one.add_argument("name")
        if verb == "set":
            one.add_argument("value", help="as YAML")
        one.set_defaults(run=run)


def _names(node: Node, target: str) -> list[str]:
    found = call(node, ListParameters, f"{target}/list_parameters", ListParameters.Request())
    return sorted(found.result.names)


def _values(node: Node, target: str, names: list[str]) -> list[Any]:
    request = GetParameters.Request(names=names)
    return list(call(node, GetParameters, f"{target}/get_parameters", request).values)


def _target(node: Node, arguments: argparse.Namespace) -> str:
    find_node(node, arguments.node)
    return full_name(arguments.node)


def list_parameters(node: Node, arguments: argparse.Namespace) -> int:
    """Print the names of the parameters of a node, or of all that have any."""
    if arguments.node:
        print("\n".join(_names(node, _target(node, arguments))))
        return 0
    wait_for_discovery(node)
    services = dict(node.get_service_names_and_types())
    for target in nodes(node):
        if f"{target}/list_parameters" in services:
            print("\n".join([f"{target}:", *(f"  {name}" for name in _names(node, target))]))
    return 0


def get(node: Node, arguments: argparse.Namespace) -> int:
    """Print one value and its type."""
    (value,) = _values(node, _target(node, arguments), [arguments.name]) or [None]
    if value is None or value.type == ParameterType.PARAMETER_NOT_SET:
        raise CommandError("Parameter not set")
    many = "are" if "values" in _TYPES[value.type] else "value is"
    print(f"{_TYPES[value.type]} {many}: {as_plain(parameter_value_to_python(value))}")
    return 0


def set_parameter(node: Node, arguments: argparse.Namespace) -> int:
    """Set one value; exit code 1 where the node refuses it."""
    wanted = Parameter(name=arguments.name, value=get_parameter_value(arguments.value))
    request = SetParameters.Request(parameters=[wanted])
    target = _target(node, arguments)
    (result,) = call(node, SetParameters, f"{target}/set_parameters", request).results
    if not result.successful:
        raise CommandError(f"Setting parameter failed: {result.reason}")
    print("Set parameter successful")
    return 0


def describe(node: Node, arguments: argparse.Namespace) -> int:
    """Print type, meaning and limits of one parameter."""
    target = _target(node, arguments)
    request = DescribeParameters.Request(names=[arguments.name])
    answer = call(node, DescribeParameters, f"{target}/describe_parameters", request)
    if not answer.descriptors or not answer.descriptors[0].type:
        raise CommandError(f"{target} has no parameter {arguments.name!r}")
    (told,) = answer.descriptors
    print(f"Parameter name: {told.name}")
    print(f"  Type: {_TYPES[told.type].lower()}")
    if told.description:
        print(f"  Description: {told.description}")
    print("  Constraints:")
    if told.read_only:
        print("    Read only: true")
    for limits in (*told.floating_point_range, *told.integer_range):
        print(f"    Min value: {limits.from_value}\n    Max value: {limits.to_value}")
    return 0


def dump_parameters(node: Node, arguments: argparse.Namespace) -> int:
    """Print all parameters of a node as a file that --params-file takes."""
    target = _target(node, arguments)
    names = _names(node, target)
    values = [as_plain(parameter_value_to_python(v)) for v in _values(node, target, names)]
    content = {target: {"ros__parameters": dict(zip(names, values, strict=True))}}
    print(yaml.safe_dump(content, sort_keys=False), end="")
    return 0
