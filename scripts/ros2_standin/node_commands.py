"""`ros2 node list | info`, `ros2 service list | type | call`, `ros2 lifecycle get | set`."""

from __future__ import annotations

import argparse
from typing import Any

from rclpy.node import Node
from shared import (
    CommandError,
    call,
    fill,
    find_node,
    full_name,
    interface_class,
    nodes,
    wait_for_discovery,
)


def add_parsers(commands: Any) -> None:
    """Declare `ros2 node ...`, `ros2 service ...` and `ros2 lifecycle ...`."""
    node = commands.add_parser("node").add_subparsers(dest="verb", required=True)
    node.add_parser("list").set_defaults(run=list_nodes)
    info = node.add_parser("info")
    info.add_argument("node")
    info.set_defaults(run=show_node)
    service = commands.add_parser("service").add_subparsers(dest="verb", required=True)
    listing = service.add_parser("list")
    listing.add_argument("-t", "--show-types", action="store_true")
    listing.set_defaults(run=list_services)
    calling = service.add_parser("call")
    calling.add_argument("service")
    calling.add_argument("type", help="package/srv/Type")
    calling.add_argument("values", nargs="?", default="{}", help="fields as YAML")
    calling.set_defaults(run=call_service)
    life = commands.add_parser("lifecycle").add_subparsers(dest="verb", required=True)
    getting = life.add_parser("get")
    getting.add_argument("node")
    getting.set_defaults(run=show_state)
    setting = life.add_parser("set")
    setting.add_argument("node")
    setting.add_argument("transition", help="configure | activate | deactivate | cleanup | ...")
    setting.set_defaults(run=change_state)


def list_nodes(node: Node, arguments: argparse.Namespace) -> int:
    """Print the full names of the other nodes."""
    wait_for_discovery(node)
    print("\n".join(nodes(node)))
    return 0


def show_node(node: Node, arguments: argparse.Namespace) -> int:
    """Print topics and services of a node."""
    at = find_node(node, arguments.node)
    wait_for_discovery(node)
    print(full_name(arguments.node))
    for title, ends in (
        ("Subscribers", node.get_subscriber_names_and_types_by_node(*at)),
        ("Publishers", node.get_publisher_names_and_types_by_node(*at)),
        ("Service Servers", node.get_service_names_and_types_by_node(*at)),
        ("Service Clients", node.get_client_names_and_types_by_node(*at)),
    ):
        print(f"  {title}:")
        for name, types in sorted(ends):
            print(f"    {name}: {', '.join(types)}")
    return 0


def list_services(node: Node, arguments: argparse.Namespace) -> int:
    """Print the services of the graph, with their types where asked for."""
    wait_for_discovery(node)
    for name, types in sorted(node.get_service_names_and_types()):
        if f"/{node.get_name()}/" not in name:
            print(f"{name} [{', '.join(types)}]" if arguments.show_types else name)
    return 0


def call_service(node: Node, arguments: argparse.Namespace) -> int:
    """Call a service and print its answer."""
    kind = interface_class(arguments.type, "srv")
    request = fill(kind.Request(), arguments.values)
    print(f"requester: making request: {request}\n", flush=True)
    print(f"response:\n{call(node, kind, full_name(arguments.service), request)}\n")
    return 0


def _ask_life(
    node: Node, arguments: argparse.Namespace, name: str, kind: str, **fields: Any
) -> Any:
    find_node(node, arguments.node)
    service = interface_class(f"lifecycle_msgs/srv/{kind}", "srv")
    target = f"{full_name(arguments.node)}/{name}"
    return call(node, service, target, service.Request(**fields))


def show_state(node: Node, arguments: argparse.Namespace) -> int:
    """Print the state of a lifecycle node."""
    state = _ask_life(node, arguments, "get_state", "GetState").current_state
    print(f"{state.label} [{state.id}]")
    return 0


def change_state(node: Node, arguments: argparse.Namespace) -> int:
    """Let a lifecycle node make a transition."""
    answer = _ask_life(
        node, arguments, "get_available_transitions", "GetAvailableTransitions"
    ).available_transitions
    known = {one.transition.label: one.transition for one in answer}
    if arguments.transition not in known:
        raise CommandError(f"Unknown transition requested, available ones are: {', '.join(known)}")
    wanted = known[arguments.transition]
    if not _ask_life(node, arguments, "change_state", "ChangeState", transition=wanted).success:
        raise CommandError("Transitioning failed; the log of the node says why")
    print("Transitioning successful")
    return 0
