"""Wait until nodes of the given names are in the graph; exit code 1 when they are not in time."""

from __future__ import annotations

import argparse
import sys
import time

import rclpy
from netpos_node import init
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions


def main() -> int:
    """Poll the graph until every name is there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="+")
    parser.add_argument("--timeout", type=float, default=90.0, help="seconds")
    arguments = parser.parse_args()
    init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is a KeyboardInterrupt
    node = Node("wait_for_nodes", start_parameter_services=False)
    end = time.monotonic() + arguments.timeout
    try:
        missing = set(arguments.names)
        while missing and time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.05)
            missing = set(arguments.names) - set(node.get_node_names())
    except KeyboardInterrupt:
        return 130
    finally:
        rclpy.try_shutdown()
    if missing:
        names = ", ".join(sorted(missing))
        print(f"netpos: not in the graph within {arguments.timeout:g} s: {names}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
