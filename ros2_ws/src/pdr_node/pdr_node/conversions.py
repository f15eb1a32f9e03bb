"""Output of the dead-reckoning core to messages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from netpos.inertial.pdr_output import PdrOutput
from netpos.inertial.pdr_values import values_of
from netpos.messages.values import Step
from netpos_node import CODEC


def messages(vue_id: str, output: PdrOutput | None) -> Iterator[tuple[bool, Any]]:
    """Each message of one core output, and whether it is a step."""
    for value in values_of(vue_id, output):
        if isinstance(value, Step):
            yield True, CODEC.step_to_msg(value)
        else:
            yield False, CODEC.velocity_to_msg(value)
