"""Parameters that the tracker and the fusion of tracks have alike."""

from __future__ import annotations

from typing import Any

from netpos.common.parameters import described, real


def max_future_s() -> Any:
    """How far ahead of the others a stamp may be [s]."""
    return real(60.0, 0.1, 1e9, "a stamp this far ahead counts only once a second one confirms it")


def integrity_risk() -> Any:
    """The risk that the protection level leaves."""
    return real(
        1e-4, 1e-12, 0.5, "probability with which the error may exceed the protection level"
    )


def odom_frame() -> Any:
    """The frame of dead reckoning, where ``map -> odom`` is given out (REP-105)."""
    return described(
        "",
        "with a name, such as {vue}/odom: /tf gets map_frame -> odom_frame, by the transform from"
        " there to base_frame that dead reckoning gives on /tf; empty: map_frame -> base_frame",
    )


def base_frame() -> Any:
    """The frame of a device's body."""
    return described("{vue}/base_link", "body frame of a device; {vue} stands for its name")
