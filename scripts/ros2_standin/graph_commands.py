"""The commands of the `ros2` stand-in: topic, node, param, service, lifecycle, interface, bag."""

from __future__ import annotations

import argparse
import os
import sys
import time

import file_commands
from shared import CommandError


def main() -> int:
    """Run one command; the exit code follows the real tool's: 0 done, 1 failed, 2 bad usage."""
    parser = argparse.ArgumentParser(prog="ros2", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    file_commands.add_parsers(commands)
    try:
        if sys.argv[1:2] and sys.argv[1] in ("interface", "bag"):
            arguments = parser.parse_args()
            return int(arguments.read(arguments))
        return in_graph(parser, commands)
    except BrokenPipeError:  # who read our output has enough of it, such as `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except CommandError as error:
        print(f"ros2: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def in_graph(parser: argparse.ArgumentParser, commands: argparse._SubParsersAction) -> int:  # type: ignore[type-arg]
    """Run a command that needs a node of its own."""
    import node_commands  # noqa: PLC0415 - rclpy takes time
    import param_commands  # noqa: PLC0415
    import rclpy  # noqa: PLC0415
    import topic_commands  # noqa: PLC0415
    from rclpy.node import Node  # noqa: PLC0415
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415

    for module in (topic_commands, node_commands, param_commands):
        module.add_parsers(commands)
    arguments = parser.parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is a KeyboardInterrupt
    node = Node(f"ros2_standin_{time.monotonic_ns()}", start_parameter_services=False)
    try:
        return int(arguments.run(node, arguments))
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
