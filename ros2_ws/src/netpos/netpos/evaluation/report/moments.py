"""Where the devices of a recording were at a few hundred times, for the slider of its map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from netpos.evaluation.pairing import Trajectory, at_stamps
from netpos.messages.values import TrackStatus

MOMENTS = 600
_AGE_S = 1.0  # an estimate older than this is none


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
    told = {status.stamp_ns: status for status in statuses}
    found: dict[str, list[Any]] = {"x": [], "y": [], "level": [], "state": []}
    for stamp, index in zip(
        stamps.tolist(), np.searchsorted(track.stamp_ns, stamps, side="right") - 1, strict=True
    ):
        at = int(track.stamp_ns[index]) if index >= 0 else -1
        here = index >= 0 and (stamp - at) * 1e-9 <= _AGE_S
        status = told.get(at) if here else None
        level = status.protection_level_m if status is not None else -1.0
        x, y = track.position[index, :2].tolist() if here else (None, None)
        found["x"].append(x)
        found["y"].append(y)
        found["level"].append(level if level >= 0.0 else None)
        found["state"].append(status.state.name if status is not None else "")
    return found


def _truths(truth: Trajectory | None, stamps: np.ndarray) -> dict[str, Any]:
    found: dict[str, Any] = {"true_x": [None] * stamps.size, "true_y": [None] * stamps.size}
    if truth is None:
        return found
    there = at_stamps(truth, stamps)
    places = np.searchsorted(stamps, there.stamp_ns)
    for place, position in zip(places.tolist(), there.position.tolist(), strict=True):
        found["true_x"][place], found["true_y"][place] = position[:2]
    return found
