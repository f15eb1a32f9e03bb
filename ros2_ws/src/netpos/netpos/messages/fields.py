"""Frames, stamps and arrays as messages carry them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from netpos.messages.values import Array

MAP_FRAME = "map"
NS = 1_000_000_000
_MALFORMED_NS = -(2**62)  # below every stamp that a Time can hold


_VUE = "{vue}"
_FRAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*")


def base_link(vue_id: str) -> str:
    """Name of a device's body frame (REP-105)."""
    return f"{vue_id}/base_link"


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of the frames of messages; ``{vue}`` in them stands for the name of a device.

    ``odom`` empty: the tracker gives ``map`` -> ``base`` itself.
    """

    map: str = MAP_FRAME
    odom: str = ""
    base: str = f"{_VUE}/base_link"

    def base_of(self, vue_id: str) -> str:
        """Body frame of a device."""
        return self.base.replace(_VUE, vue_id)

    def odom_of(self, vue_id: str) -> str:
        """Frame in which the device's dead reckoning gives its place."""
        return self.odom.replace(_VUE, vue_id)

    def check(self) -> None:
        """Raises ``ValueError`` for a name that no frame can have, or one used twice."""
        for name, text in (("map_frame", self.map), ("base_frame", self.base)):
            _check_frame(name, text)
        if self.odom:
            _check_frame("odom_frame", self.odom)
        if _VUE in self.map:
            raise ValueError(f"map_frame is one for all devices, got {self.map!r}")
        used = [text for text in (self.map, self.odom, self.base) if text]
        if len(set(used)) < len(used):
            raise ValueError(f"map_frame, odom_frame and base_frame must differ, got {used}")


def _check_frame(name: str, text: str) -> None:
    if not _FRAME.fullmatch(text.replace(_VUE, "vue")):
        raise ValueError(
            f"{name} {text!r} is no name of a frame; use letters, digits, _ and /, no / first"
        )


def vue_of_frame(frame_id: str) -> str:
    """Device name of a body frame; the inverse of ``base_link``."""
    return frame_id.rsplit("/", 1)[0]


def stamp_ns(time: Any) -> int:
    """Integer nanoseconds of a builtin_interfaces/Time.

    A Time whose ``nanosec`` is a second or more says nothing certain. It becomes a number that
    ``malformed_nanosec`` knows, and that whoever takes stamps refuses.
    """
    nanosec = int(time.nanosec)
    if nanosec >= NS:
        return _MALFORMED_NS - nanosec
    return int(time.sec) * NS + nanosec


def malformed_nanosec(stamp_ns: int) -> int | None:
    """The ``nanosec`` of an invalid Time; None for a valid stamp."""
    return _MALFORMED_NS - stamp_ns if stamp_ns <= _MALFORMED_NS - NS else None


def stamp_fault(stamp_ns: int) -> str | None:
    """Reason to refuse a stamp, or None: ``zero_stamp`` (not after 0), ``bad_stamp``."""
    if stamp_ns > 0:
        return None
    return "zero_stamp" if malformed_nanosec(stamp_ns) is None else "bad_stamp"


def certain_stamp_ns(time: Any) -> int:
    """``stamp_ns`` for messages that are checked nowhere else; ValueError for an invalid Time."""
    ns = stamp_ns(time)
    nanosec = malformed_nanosec(ns)
    if nanosec is not None:
        raise ValueError(bad_stamp(nanosec))
    return ns


def bad_stamp(nanosec: int) -> str:
    """Sentence about an invalid Time."""
    return f"header.stamp.nanosec is {nanosec}; send one below {NS}"


def xyz(point: Any) -> Array:
    """Point or vector message as (3,)."""
    return np.array([point.x, point.y, point.z], dtype=np.float64)


def square(values: Any, n: int) -> Array:
    """Flat covariance of a message as (n, n)."""
    return np.asarray(values, dtype=np.float64).reshape(n, n)


def flat(matrix: Array) -> Array:
    """Matrix as the flat row-major array a message takes."""
    return np.ascontiguousarray(matrix, dtype=np.float64).reshape(-1)


def embed(cov: Array) -> Array:
    """(2, 2) or (3, 3) covariance in the top left corner of a flat (6, 6)."""
    full = np.zeros((6, 6))
    full[: len(cov), : len(cov)] = cov
    return full.reshape(-1)


def imu_covariance(variance: float) -> Array:
    """Flat (3, 3) of equal variances; -1 (not measured, REP-145) only in the first element."""
    cov = np.zeros(9)
    cov[0::4] = variance
    if variance < 0.0:
        cov[4] = cov[8] = 0.0
    return cov


def lever_arm(msg: Any) -> tuple[float, float, float]:
    """Lever arm of a netpos_msgs/RsuMeasurement; recordings made before it had one have none."""
    arm = getattr(msg, "lever_arm", None)
    return (0.0, 0.0, 0.0) if arm is None else (float(arm.x), float(arm.y), float(arm.z))
