"""Nodes built in the process of a test and fed by their callbacks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message


class Kept:
    """A publisher that keeps what it is given: messages, or those of a kind from their bytes."""

    def __init__(self, kind: Any = None) -> None:
        self.messages: list[Any] = []
        self._kind = kind

    def publish(self, msg: Any) -> None:
        self.messages.append(deserialize_message(msg, self._kind) if self._kind else msg)


@contextmanager
def nodes_of(kind: Any, domain_id: int) -> Iterator[Any]:
    """A function that makes nodes of a class with the parameters it is given; they and their
    context end with the block."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain_id)
    nodes = []

    def node(**overrides: Any) -> Any:
        values = [Parameter(name, value=value) for name, value in overrides.items()]
        nodes.append(kind(context=context, parameter_overrides=values))
        return nodes[-1]

    yield node
    for one in nodes:
        one.destroy_node()
    rclpy.shutdown(context=context)
