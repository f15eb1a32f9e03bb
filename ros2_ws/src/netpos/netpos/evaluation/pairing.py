"""Estimates beside the truth at the same instants.

The truth is interpolated at each estimate's stamp, so every estimate has at most one partner and
no estimate is moved in time: position and velocity linearly, heading along the shorter arc.
Stamps are integer nanoseconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from netpos.messages.values import Array, Odometry

Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_TRUTH_GAP_S = 1.0


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
        """Trajectory of odometry messages in the order they were recorded.

        The twist is turned from base_link into map axes. Of several messages with one stamp the
        last counts. A message with a value that is not finite, or without an orientation (zero
        quaternion), is left out and counted as invalid.
        """
        poses = list(poses)
        valid = [pose for pose in poses if _is_valid(pose)]
        last = {pose.stamp_ns: pose for pose in valid}
        kept = [last[stamp] for stamp in sorted(last)]
        rotation = _rotations(kept)
        return cls(
            stamp_ns=np.array([pose.stamp_ns for pose in kept], dtype=np.int64),
            position=_stack([pose.position for pose in kept], 3),
            velocity=np.einsum(
                "nij,nj->ni", rotation, _stack([pose.linear_velocity for pose in kept], 3)
            ),
            heading=np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
            position_cov=_stack([pose.pose_cov[:3, :3] for pose in kept], 3, 3),
            duplicates=len(valid) - len(kept),
            invalid=len(poses) - len(valid),
        )


def _stack(rows: list[Array], *shape: int) -> Array:
    return np.array(rows, dtype=np.float64).reshape(len(rows), *shape)


def _is_valid(pose: Odometry) -> bool:
    values = (pose.position, pose.quaternion, pose.linear_velocity)
    return all(np.isfinite(v).all() for v in values) and float(np.linalg.norm(pose.quaternion)) > 0


def _rotations(poses: list[Odometry]) -> Array:
    if not poses:
        return np.zeros((0, 3, 3))
    return np.asarray(Rotation.from_quat([pose.quaternion for pose in poses]).as_matrix())


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
    found = bracket(estimate.stamp_ns, truth.stamp_ns, max_truth_gap_s)
    partner = estimate.take(found.inside)
    return Pairs(
        estimate=partner,
        truth=Trajectory(
            stamp_ns=partner.stamp_ns,
            position=found.interpolate(truth.position),
            velocity=found.interpolate(truth.velocity),
            heading=found.interpolate_angle(truth.heading),
            position_cov=found.interpolate(truth.position_cov),
        ),
        outside=found.outside,
        in_gap=found.in_gap,
    )
