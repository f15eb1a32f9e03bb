"""Where the devices of a recording were at a few hundred times, for the slider of its map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from netpos.evaluation.pairing import Trajectory, at_stamps
from netpos.messages.values import TrackStatus

MOMENTS = 600
_AGE_S = 1.0  # an older estimate is not shown


def moments_of(
    tracks: Mapping[str, tuple[Trajectory, Sequence[TrackStatus], Trajectory | None]],
) -> dict[str, Any]:
    """Plain types: ``t`` [s] since the first estimate, and for each device its newest estimate
    (``x``, ``y`` [m], None: none for a second), protection ``level`` [m], ``state``, and true
    place, of ``tracks``: estimate, statuses and ground truth by device."""
    spans = [(t.stamp_ns[0], t.stamp_ns[-1]) for t, _, _ in tracks.values() if len(t)]
    if not spans:
        return {"t": [], "devices": []}
    first, last = min(s for s, _ in spans), max(s for _, s in spans)
    stamps = np.linspace(first, last, MOMENTS).astype(np.int64)
    return {
        "t": ((stamps - first) * 1e-9).round(3).tolist(),
        "devices": [
            {"name": name, **_estimates(track, statuses, stamps), **_truths(truth, stamps)}
            for name, (track, statuses, truth) in tracks.items()
        ],
    }


def _estimates(
    track: Trajectory, statuses: Sequence[TrackStatus], stamps: np.ndarray
) -> dict[str, Any]:
    status_by_stamp = {status.stamp_ns: status for status in statuses}
    columns: dict[str, list[Any]] = {"x": [], "y": [], "level": [], "state": []}
    for stamp, index in zip(
        stamps.tolist(), np.searchsorted(track.stamp_ns, stamps, side="right") - 1, strict=True
    ):
        estimate_ns = int(track.stamp_ns[index]) if index >= 0 else -1
        here = index >= 0 and (stamp - estimate_ns) * 1e-9 <= _AGE_S
        status = status_by_stamp.get(estimate_ns) if here else None
        level = status.protection_level_m if status is not None else -1.0
        x, y = track.position[index, :2].tolist() if here else (None, None)
        columns["x"].append(x)
        columns["y"].append(y)
        columns["level"].append(level if level >= 0.0 else None)
        columns["state"].append(status.state.name if status is not None else "")
    return columns


def _truths(truth: Trajectory | None, stamps: np.ndarray) -> dict[str, Any]:
    columns: dict[str, Any] = {"true_x": [None] * stamps.size, "true_y": [None] * stamps.size}
    if truth is None:
        return columns
    there = at_stamps(truth, stamps)
    places = np.searchsorted(stamps, there.stamp_ns)
    for row, position in zip(places.tolist(), there.position.tolist(), strict=True):
        columns["true_x"][row], columns["true_y"][row] = position[:2]
    return columns
