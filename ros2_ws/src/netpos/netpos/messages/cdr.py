"""Convert values directly from and to the bytes of their messages (little-endian XCDR1).

Gives the same result as ``netpos.messages.codec`` with a serialiser of whole messages, but faster,
for the messages that come many times a second.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np

from netpos.messages.fields import NS, Frames, vue_of_frame
from netpos.messages.values import (
    Array,
    ClockState,
    Field,
    ImuSample,
    Odometry,
    RsuMeasurement,
    TrackStatus,
)

STRING = "string"
_ENCAPSULATION = b"\0\1\0\0"  # ahead of the fields; alignment counts from its end
_NAMES = 4096  # texts kept encoded and decoded: frames, devices, RSUs, reasons


@lru_cache(_NAMES)
def _encoded(text: str) -> bytes:
    return text.encode() + b"\0"


@lru_cache(_NAMES)
def _decoded(block: bytes) -> str:
    if not block.endswith(b"\0"):
        raise ValueError("a string without its end")
    return block[:-1].decode()


@cache
def _fixed(codes: tuple[str, ...], phase: int) -> struct.Struct:
    """Fields of fixed size that begin ``phase`` bytes after a multiple of 8; padding is zero."""
    position, text = phase, "<"
    for code in codes:
        count, width = int(code[:-1] or 1), struct.calcsize(f"<{code[-1]}")
        padding = -position % width
        text += f"{padding}x" + (code if count == 1 else f"{count * width}s")
        position += padding + count * width
    return struct.Struct(text)


@lru_cache(_NAMES)
def _texts(values: tuple[str, ...], phase: int) -> bytes:
    content = b"\0" * phase
    for text in map(_encoded, values):
        content += _fixed(("I",), len(content) & 7).pack(len(text)) + text
    return content[phase:]


def _sequence(code: str, values: Sequence[Any], phase: int) -> bytes:
    if code == STRING:
        return _texts(tuple(values), phase)
    return _fixed((code,) * len(values), phase).pack(*values) if values else b""


class Layout:
    """Positions of the fields of a message type in its bytes, for strings of any length.

    ``items`` are its fields without nesting, in the order of the definition: a code of the module
    ``struct``, an array of them (``"36d"``, as bytes), ``"string"``, or a sequence (``"Q[]"``).
    """

    def __init__(self, items: Iterable[str]) -> None:
        # Fields of fixed size up to a string or a sequence, by where they begin; then what follows
        self._runs: list[tuple[tuple[struct.Struct, ...], int, str]] = []
        codes: tuple[str, ...] = ()
        first: struct.Struct | None = None
        for item in (*items, ""):
            if item in ("", STRING) or item.endswith("[]"):
                first = first or _fixed(codes, 0)
                counted = (*codes, "I") if item else codes
                by_phase = tuple(_fixed(counted, phase) for phase in range(8))
                self._runs.append((by_phase, len(codes), item))
                codes = ()
            else:
                codes += (item,)
        assert first is not None
        self._first = first  # what comes before the first string
        # Few senders, many messages. Of those read: where what follows the last string begins,
        # by size, and the fields from the first string to the last, by their bytes.
        self._ends: dict[int, tuple[int, struct.Struct]] = {}
        self._middles: dict[bytes, list[Any]] = {}

    def pack(self, *values: Any) -> bytes:
        """The message; ``struct.error`` where a value does not fit its field."""
        parts, position, first = [_ENCAPSULATION], 0, 0
        for by_phase, n, kind in self._runs:
            fixed, last = by_phase[position & 7], first + n
            position += fixed.size
            if not kind:
                parts.append(fixed.pack(*values[first:]))
                break
            if kind == STRING:
                content = _encoded(values[last])
                count = len(content)
            else:
                content = _sequence(kind[:-2], values[last], position & 7)
                count = len(values[last])
            parts += (fixed.pack(*values[first:last], count), content)
            position += len(content)
            first = last + 1
        return b"".join(parts)

    def unpack(self, cdr: bytes) -> list[Any] | None:
        """The fields, or None for what needs a closer look: another encoding, a message that is
        cut or damaged, a type with sequences."""
        parts = self.parts(cdr)
        return None if parts is None else [value for part in parts for value in part]

    def parts(self, cdr: bytes) -> tuple[Sequence[Any], Sequence[Any], Sequence[Any]] | None:
        """``unpack``: the fields before the first string, from it to the last one, after it."""
        if not cdr.startswith(_ENCAPSULATION):
            return None
        known = self._ends.get(len(cdr))
        if known is not None:
            last_start, last = known
            middle = self._middles.get(cdr[4 + self._first.size : last_start])
            if middle is not None:
                return self._first.unpack_from(cdr, 4), middle, last.unpack_from(cdr, last_start)
        values = self._walk(cdr)
        if values is None:
            return None
        if len(self._runs) == 1:
            return values, (), ()
        begin, end = self._runs[0][1], len(values) - self._runs[-1][1]
        return values[:begin], values[begin:end], values[end:]

    def _walk(self, cdr: bytes) -> list[Any] | None:
        """The fields, run by run; notes where the strings are and what they say."""
        values: list[Any] = []
        position = begin = 4
        try:
            for by_phase, _, kind in self._runs:
                fixed, begin = by_phase[(position - 4) & 7], position
                values += fixed.unpack_from(cdr, position)
                position += fixed.size
                if kind:
                    if kind != STRING:
                        return None
                    end = position + values.pop()
                    values.append(_decoded(cdr[position:end]))
                    position = end
        except (struct.error, ValueError):
            return None
        if not 0 <= len(cdr) - position < 4:
            return None
        if len(self._runs) > 1:
            if len(self._middles) >= _NAMES:
                self._ends, self._middles = {}, {}
            self._ends[len(cdr)] = begin, fixed
            middle = values[self._runs[0][1] : len(values) - self._runs[-1][1]]
            self._middles[cdr[4 + self._first.size : begin]] = middle
        return values


def _bytes(matrix: Array) -> bytes:
    return np.asarray(matrix, dtype="<f8").tobytes()


def _matrix(block: bytes, n: int) -> Array:
    return np.frombuffer(block, dtype="<f8").reshape(n, n)


def _shared_zeros(*shape: int) -> Array:
    zeros = np.zeros(shape)
    zeros.flags.writeable = False
    return zeros


_field = lru_cache(256)(Field)
_first = struct.Struct("<d").unpack_from
_NO_POSITION, _NO_COV = _shared_zeros(3), _shared_zeros(3, 3)
_ZERO_POSITION = bytes(12 * 8)  # position and its covariance, at the end of a measurement


class CdrCodec:
    """Reads and writes the bytes of messages; ``items`` flattens a type for ``Layout``.

    What reads returns None where the codec of messages has to look.
    """

    def __init__(
        self, items: Callable[[str], Iterable[str]], frames: Frames | None = None
    ) -> None:
        self._frames = frames or Frames()
        self._measurement = Layout(items("netpos_msgs/msg/RsuMeasurement"))
        self._imu = Layout(items("sensor_msgs/msg/Imu"))
        self._odometry = Layout(items("nav_msgs/msg/Odometry"))
        self._transform = Layout(("I", *items("geometry_msgs/msg/TransformStamped")))
        self._clock_state = Layout(items("netpos_msgs/msg/ClockState"))
        self._track_status = Layout(items("netpos_msgs/msg/TrackStatus"))

    def source(self, cdr: bytes) -> tuple[str, str, int] | None:
        """RSU, device and stamp [ns] of a netpos_msgs/RsuMeasurement, of which nothing else is
        read."""
        parts = self._measurement.parts(cdr)
        if parts is None:
            return None
        (sec, nanosec), (_, rsu_id, vue_id, _), _ = parts
        return rsu_id, vue_id, sec * NS + nanosec

    def measurement(self, cdr: bytes) -> RsuMeasurement | None:
        """Value of a netpos_msgs/RsuMeasurement; values are not judged here."""
        parts = self._measurement.parts(cdr)
        if parts is None:
            return None
        (sec, nanosec), (frame_id, rsu_id, vue_id, reference_rsu_id), scalars = parts
        if nanosec >= NS:
            return None
        value = RsuMeasurement.__new__(RsuMeasurement)  # the defaults would cost most
        value.stamp_ns, value.rsu_id, value.vue_id = sec * NS + nanosec, rsu_id, vue_id
        value.frame_id, value.reference_rsu_id = frame_id, reference_rsu_id
        (
            value.sequence,
            value.expected,
            fields,
            value.line_of_sight,
            value.rssi_dbm,
            value.azimuth_rad,
            value.azimuth_var,
            value.elevation_rad,
            value.elevation_var,
            value.toa_s,
            value.toa_var,
            value.range_m,
            value.range_var,
            value.phase_difference_rad,
            value.phase_difference_var,
            value.tdoa_s,
            value.tdoa_var,
            *lever_and_position,
        ) = scalars
        x, y, z, *position, position_cov = lever_and_position
        value.fields, value.lever_arm = _field(fields), (x, y, z)
        if cdr.endswith(_ZERO_POSITION):
            value.position, value.position_cov = _NO_POSITION, _NO_COV
        else:
            value.position, value.position_cov = np.array(position), _matrix(position_cov, 3)
        return value

    def imu(self, cdr: bytes, vue_id: str | None = None) -> ImuSample | None:
        """Value of a sensor_msgs/Imu of a device (default: the one its frame names)."""
        values = self._imu.unpack(cdr)
        if values is None:
            return None
        sec, nanosec, frame, *_, gx, gy, gz, rate_cov, ax, ay, az, force_cov = values
        if nanosec >= NS:
            return None
        return ImuSample(
            stamp_ns=sec * NS + nanosec,
            vue_id=vue_id or vue_of_frame(frame),
            angular_velocity=np.array((gx, gy, gz)),
            specific_force=np.array((ax, ay, az)),
            angular_velocity_var=_first(rate_cov)[0],
            specific_force_var=_first(force_cov)[0],
        )

    def odometry(self, value: Odometry) -> bytes:
        """nav_msgs/Odometry: pose in map, twist in the device's base_link."""
        return self._odometry.pack(
            *divmod(value.stamp_ns, NS),
            self._frames.map,
            self._frames.base_of(value.vue_id),
            *value.position.tolist(),
            *value.quaternion.tolist(),
            _bytes(value.pose_cov),
            *value.linear_velocity.tolist(),
            *value.angular_velocity.tolist(),
            _bytes(value.twist_cov),
        )

    def transform(self, value: Odometry) -> bytes:
        """tf2_msgs/TFMessage with map -> base_link."""
        return self._transform.pack(
            1,
            *divmod(value.stamp_ns, NS),
            self._frames.map,
            self._frames.base_of(value.vue_id),
            *value.position.tolist(),
            *value.quaternion.tolist(),
        )

    def map_to_odom(self, vue_id: str, stamp_ns: int, position: Array, q: Array) -> bytes:
        """tf2_msgs/TFMessage with map -> odom of a device."""
        return self._transform.pack(
            1,
            *divmod(stamp_ns, NS),
            self._frames.map,
            self._frames.odom_of(vue_id),
            *position.tolist(),
            *q.tolist(),
        )

    def clock_state(self, value: ClockState) -> bytes:
        """netpos_msgs/ClockState."""
        return self._clock_state.pack(
            *divmod(value.stamp_ns, NS),
            self._frames.base_of(value.vue_id),
            value.offset_s,
            value.drift,
            _bytes(value.cov),
        )

    def track_status(self, value: TrackStatus) -> bytes:
        """netpos_msgs/TrackStatus."""
        reasons = sorted(value.rejected)
        return self._track_status.pack(
            *divmod(value.stamp_ns, NS),
            self._frames.base_of(value.vue_id),
            value.state,
            value.nis,
            value.nis_dof,
            value.used,
            value.accepted,
            sum(value.rejected.values()),
            reasons,
            [value.rejected[reason] for reason in reasons],
            value.sources,
            value.position_sd_m,
            value.protection_level_m,
            value.steps.length_factor,
            value.steps.length_factor_sd,
            value.steps.heading_offset_rad,
            value.steps.heading_offset_sd_rad,
            [mode.weight for mode in value.modes],
            [mode.x_m for mode in value.modes],
            [mode.y_m for mode in value.modes],
            value.reason,
        )
