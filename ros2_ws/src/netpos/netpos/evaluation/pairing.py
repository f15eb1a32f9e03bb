"""Estimates beside the truth at the same instants.

The truth is interpolated at each estimate's stamp, so every estimate has at most one partner and
no estimate is moved in time: position and velocity linearly, heading along the shorter arc.
Stamps are integer nanoseconds.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from netpos.messages.values import UNKNOWN_HEIGHT_VAR, Array, ClockState, Odometry

Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_TRUTH_GAP_S = 1.0
# Columns of a pose after its position.
_QUATERNION, _VELOCITY, _COV, _POSE_VALUES = slice(3, 7), slice(7, 10), 10, 19


def has_height(truth: Trajectory) -> Mask:
    """Whether each pose of a ground truth (n,) has a height: its variance is below
    ``UNKNOWN_HEIGHT_VAR``, which stands for none."""
    return np.asarray(truth.position_cov[:, 2, 2] < UNKNOWN_HEIGHT_VAR)


def wrap_angle(angle: Array) -> Array:
    """Angle in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """Poses of one device in strictly increasing time.

    stamp_ns (n,); position (n, 3) m and velocity (n, 3) m/s in map axes; heading (n,) rad
    counter-clockwise from east; position_cov (n, 3, 3) m^2, zero where unknown. ``duplicates``
    and ``invalid`` count the messages left out.
    """

    stamp_ns: Stamps
    position: Array
    velocity: Array
    heading: Array
    position_cov: Array
    duplicates: int = 0
    invalid: int = 0

    def __len__(self) -> int:
        return self.stamp_ns.size

    def take(self, index: NDArray[np.int64] | Mask | slice) -> Trajectory:
        """The poses at ``index``; the counts stay with the original."""
        return Trajectory(
            stamp_ns=self.stamp_ns[index],
            position=self.position[index],
            velocity=self.velocity[index],
            heading=self.heading[index],
            position_cov=self.position_cov[index],
        )

    @classmethod
    def of(cls, poses: Iterable[Odometry]) -> Trajectory:
        """Trajectory of odometry messages in the order they were recorded; see ``Poses``."""
        columns = Poses()
        for pose in poses:
            columns.append(pose)
        return columns.trajectory()


class Poses:
    """Odometry messages as they are read, in the order they were recorded: their numbers only."""

    def __init__(self) -> None:
        self._stamps = array("q")
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    def append(self, pose: Odometry) -> None:
        """One message more."""
        self._stamps.append(pose.stamp_ns)
        for values in (pose.position, pose.quaternion, pose.linear_velocity):
            self._values.extend(values.tolist())
        self._values.extend(pose.pose_cov[:3, :3].ravel().tolist())

    def trajectory(self) -> Trajectory:
        """The poses in increasing time.

        The twist is turned from base_link into map axes. Of several messages with one stamp the
        last counts. A message with a value that is not finite, or without an orientation (zero
        quaternion), is left out and counted as invalid.
        """
        stamps = np.array(self._stamps, dtype=np.int64)
        values = np.array(self._values, dtype=np.float64).reshape(-1, _POSE_VALUES)
        moving = values[:, :_COV]
        valid = np.isfinite(moving).all(axis=1) & (moving[:, _QUATERNION] != 0.0).any(axis=1)
        stamps, values = stamps[valid], values[valid]
        kept = _last_of_each(stamps)
        values = values[kept]
        turn = _rotations(values[:, _QUATERNION])
        return Trajectory(
            stamp_ns=stamps[kept],
            position=values[:, :3].copy(),
            velocity=np.einsum("nij,nj->ni", turn, values[:, _VELOCITY]),
            heading=np.arctan2(turn[:, 1, 0], turn[:, 0, 0]),
            position_cov=values[:, _COV:].copy().reshape(-1, 3, 3),
            duplicates=int(valid.sum()) - kept.size,
            invalid=valid.size - int(valid.sum()),
        )


def _rotations(quaternions: Array) -> Array:
    """(n, 3, 3); SciPy takes no 0 of them."""
    if not len(quaternions):
        return np.zeros((0, 3, 3))
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockOffsets:
    """Offsets of a device's clock: stamp_ns (n,) strictly increasing, offset_s (n,)."""

    stamp_ns: Stamps
    offset_s: Array

    def at(self, stamp_ns: Stamps, max_gap_s: float = MAX_TRUTH_GAP_S) -> ClockOffsets:
        """At those of the stamps that ``bracket`` finds a place for."""
        bracketed = bracket(stamp_ns, self.stamp_ns, max_gap_s)
        return ClockOffsets(
            stamp_ns=stamp_ns[bracketed.inside], offset_s=bracketed.interpolate(self.offset_s)
        )

    @classmethod
    def of(cls, states: Iterable[ClockState]) -> ClockOffsets:
        """Of clock states in the order they were recorded; see ``Clock``."""
        columns = Clock()
        for state in states:
            columns.append(state)
        return columns.offsets()


class Clock:
    """Clock states as they are read, in the order they were recorded: two numbers each."""

    def __init__(self) -> None:
        self._stamps = array("q")
        self._offsets = array("d")

    def append(self, state: ClockState) -> None:
        """One message more."""
        self._stamps.append(state.stamp_ns)
        self._offsets.append(state.offset_s)

    def offsets(self) -> ClockOffsets:
        """Those that are finite, of several with one stamp the last, in increasing time."""
        stamps, offsets = np.array(self._stamps, dtype=np.int64), np.array(self._offsets)
        finite = np.isfinite(offsets)
        kept = _last_of_each(stamps[finite])
        return ClockOffsets(stamp_ns=stamps[finite][kept], offset_s=offsets[finite][kept])


def _last_of_each(stamp_ns: Stamps) -> NDArray[np.int64]:
    """Indices that sort the stamps, of equal ones the last: the first one from behind."""
    _, from_behind = np.unique(stamp_ns[::-1], return_index=True)
    return stamp_ns.size - 1 - from_behind


@dataclass(frozen=True, slots=True, kw_only=True)
class Bracket:
    """Where query stamps lie between the base stamps: base[lower] + weight * (base[upper] -
    base[lower]).

    All arrays belong to the queries inside; ``inside`` (m,) is the mask over all queries,
    ``outside`` and ``in_gap`` count the rest.
    """

    inside: Mask
    lower: NDArray[np.int64]
    upper: NDArray[np.int64]
    weight: Array
    outside: int
    in_gap: int

    def interpolate(self, values: Array) -> Array:
        """Linear interpolation of (k, ...) values known at the base stamps."""
        low, high = values[self.lower], values[self.upper]
        weight = self.weight.reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(low + weight * (high - low))

    def interpolate_angle(self, angles: Array) -> Array:
        """Interpolation of (k,) angles [rad] along the shorter arc."""
        low = angles[self.lower]
        return wrap_angle(low + self.weight * wrap_angle(angles[self.upper] - low))


def bracket(query_ns: Stamps, base_ns: Stamps, max_gap_s: float = MAX_TRUTH_GAP_S) -> Bracket:
    """Find each query between two base stamps (both strictly increasing).

    A query outside the base's span, or strictly inside a base interval longer than ``max_gap_s``,
    has no partner. A query on a base stamp always has.
    """
    if not max_gap_s > 0:
        raise ValueError(f"max_gap_s must be > 0, got {max_gap_s}")
    if base_ns.size == 0:
        none = np.zeros(0, dtype=np.int64)
        inside = np.zeros(query_ns.size, dtype=np.bool_)
        return Bracket(
            inside=inside,
            lower=none,
            upper=none,
            weight=np.zeros(0),
            outside=query_ns.size,
            in_gap=0,
        )
    spanned = (query_ns >= base_ns[0]) & (query_ns <= base_ns[-1])
    lower = np.clip(np.searchsorted(base_ns, query_ns, side="right") - 1, 0, base_ns.size - 1)
    upper = np.where(base_ns[lower] == query_ns, lower, np.minimum(lower + 1, base_ns.size - 1))
    width = base_ns[upper] - base_ns[lower]
    gap = spanned & (width > round(max_gap_s * 1e9))
    inside = spanned & ~gap
    lower, upper, width = lower[inside], upper[inside], width[inside]
    weight = (query_ns[inside] - base_ns[lower]) / np.maximum(width, 1)
    return Bracket(
        inside=inside,
        lower=lower,
        upper=upper,
        weight=weight,
        outside=int(np.count_nonzero(~spanned)),
        in_gap=int(np.count_nonzero(gap)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairs:
    """Estimates and the truth at their stamps, row by row; ``outside`` and ``in_gap`` count
    estimates without a partner.
    """

    estimate: Trajectory
    truth: Trajectory
    outside: int = 0
    in_gap: int = 0

    def __len__(self) -> int:
        return len(self.estimate)

    @property
    def error(self) -> Array:
        """(n, 3) estimate minus truth [m]."""
        return self.estimate.position - self.truth.position

    @property
    def horizontal_error(self) -> Array:
        """(n,) length of the horizontal error [m]."""
        return np.asarray(np.linalg.norm(self.error[:, :2], axis=1))

    def take(self, index: Mask | slice) -> Pairs:
        """The rows at ``index``; the counts stay."""
        return Pairs(
            estimate=self.estimate.take(index),
            truth=self.truth.take(index),
            outside=self.outside,
            in_gap=self.in_gap,
        )


def pair(
    estimate: Trajectory, truth: Trajectory, max_truth_gap_s: float = MAX_TRUTH_GAP_S
) -> Pairs:
    """Pair every estimate with the interpolated truth; see ``bracket`` for those that have no
    partner.
    """
    bracketed = bracket(estimate.stamp_ns, truth.stamp_ns, max_truth_gap_s)
    return Pairs(
        estimate=estimate if bracketed.inside.all() else estimate.take(bracketed.inside),
        truth=_between(truth, bracketed, estimate.stamp_ns),
        outside=bracketed.outside,
        in_gap=bracketed.in_gap,
    )


def at_stamps(
    track: Trajectory, stamp_ns: Stamps, max_gap_s: float = MAX_TRUTH_GAP_S
) -> Trajectory:
    """The track at those of the stamps that ``bracket`` finds a place for."""
    return _between(track, bracket(stamp_ns, track.stamp_ns, max_gap_s), stamp_ns)


def _between(track: Trajectory, bracketed: Bracket, stamp_ns: Stamps) -> Trajectory:
    return Trajectory(
        stamp_ns=stamp_ns[bracketed.inside],
        position=bracketed.interpolate(track.position),
        velocity=bracketed.interpolate(track.velocity),
        heading=bracketed.interpolate_angle(track.heading),
        position_cov=bracketed.interpolate(track.position_cov),
    )
