"""Truth with a clock or axes of its own, brought onto the measurements.

The measurements alone give a plain track: least squares over each second. The truth is turned and
shifted onto it. Figures of such a truth are optimistic: it has followed what the measurements have
in common, such as a wrong position of the whole network.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from netpos.bags.errors import BagError
from netpos.bags.importers.own.truth import Poses
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement

Way = Literal["none", "shift", "rigid"]
WINDOW_NS = 1_000_000_000
FEWEST = 3
"""RSUs in a second, and seconds in common with the truth."""
_SEARCH_S = 0.5
_ROBUST_M = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """What was done to the truth: turned by ``angle_rad`` about z, then moved by ``shift`` (3,) m,
    later by ``offset_s``; what was left over ``seconds`` windows."""

    angle_rad: float
    shift: Array
    offset_s: float
    remaining_rms_m: float
    seconds: int

    def sentence(self) -> str:
        """For people."""
        return (
            f"truth aligned to the measurements: turned {math.degrees(self.angle_rad):.2f} deg, "
            f"shifted ({self.shift[0]:.3f}, {self.shift[1]:.3f}) m, later by "
            f"{self.offset_s:.3f} s ({self.remaining_rms_m:.3f} m rms left over "
            f"{self.seconds} s); figures are optimistic"
        )


def plain_track(
    infos: Sequence[RsuInfo], measurements: Sequence[RsuMeasurement], height_m: float
) -> tuple[Array, Array]:
    """Times (n,) s and horizontal positions (n, 2) m of least squares over each second, of ranges
    with at least three RSUs, or of fixes.

    Raises ``BagError`` where no second has enough.
    """
    places = {info.rsu_id: info.position for info in infos}
    windows: dict[int, list[RsuMeasurement]] = defaultdict(list)
    for measurement in measurements:
        windows[measurement.stamp_ns // WINDOW_NS].append(measurement)
    times, track = [], []
    start = np.mean([info.position[:2] for info in infos], axis=0)
    for _, window in sorted(windows.items()):
        found = _least_squares(window, places, height_m, start)
        if found is not None:
            start = found
            times.append(np.mean([m.stamp_ns / 1e9 for m in window]))
            track.append(found)
    if len(times) < FEWEST:
        raise BagError(
            "the truth cannot be aligned: no three seconds hold ranges of three RSUs, or fixes; "
            "give --truth-align none and the time offset as a number"
        )
    return np.array(times), np.array(track)


def _least_squares(
    window: Sequence[RsuMeasurement], places: Mapping[str, Array], height_m: float, start: Array
) -> Array | None:
    fixes = [m.position[:2] for m in window if m.fields & Field.POSITION]
    if fixes:
        return np.asarray(np.mean(fixes, axis=0))
    ranges = [m for m in window if m.fields & Field.RANGE]
    if len({m.rsu_id for m in ranges}) < FEWEST:
        return None
    anchors = np.array([places[m.rsu_id] for m in ranges])
    measured = np.array([m.range_m for m in ranges])

    def residuals(place: Array) -> Array:
        return np.asarray(
            np.linalg.norm(anchors - [place[0], place[1], height_m], axis=1) - measured
        )

    found = least_squares(residuals, start, loss="soft_l1", f_scale=_ROBUST_M)
    return np.asarray(found.x)


def align(
    truth: Poses, times_s: Array, track: Array, way: Way, offset_s: float | None
) -> Alignment:
    """The best turn and shift of the truth, and the best time offset where none is given.

    Raises ``BagError`` where truth and track have less than three seconds in common.
    """
    truth_s = truth.stamps_ns / 1e9
    if offset_s is None:
        offset_s = _best_offset(truth_s, truth.values[:, :2], times_s, track, way)
    found = _fit(truth_s + offset_s, truth.values[:, :2], times_s, track, way)
    if found is None:
        raise BagError(
            "the truth and the measurements have less than three seconds in common; give "
            "--truth-time-offset auto or the seconds"
        )
    angle_rad, shift, rms_m, count = found
    return Alignment(
        angle_rad=angle_rad,
        shift=np.array([*shift, 0.0]),
        offset_s=offset_s,
        remaining_rms_m=rms_m,
        seconds=count,
    )


def _best_offset(truth_s: Array, truth: Array, times_s: Array, track: Array, way: Way) -> float:
    """Of all offsets at which half of the shorter recording is covered, the one with the least
    left over."""
    need = max(FEWEST, min(len(times_s), int(truth_s[-1] - truth_s[0])) // 2)

    def cost(offset_s: float) -> float:
        found = _fit(truth_s + offset_s, truth, times_s, track, way)
        return math.inf if found is None or found[3] < need else found[2]

    first, last = times_s[0] - truth_s[-1], times_s[-1] - truth_s[0]
    offsets = np.arange(first, last + _SEARCH_S, _SEARCH_S)
    costs = [cost(offset_s) for offset_s in offsets]
    best = int(np.argmin(costs))
    if not math.isfinite(costs[best]):
        raise BagError("the truth is too short to find its time offset; give the seconds")
    near = minimize_scalar(
        cost,
        bounds=(offsets[best] - _SEARCH_S, offsets[best] + _SEARCH_S),
        method="bounded",
        options={"xatol": 1e-3},
    )
    return float(near.x)


def _fit(
    truth_s: Array, truth: Array, times_s: Array, track: Array, way: Way
) -> tuple[float, Array, float, int] | None:
    """Angle, shift (2,), rms of what is left and number of seconds; None where too few."""
    inside = (times_s >= truth_s[0]) & (times_s <= truth_s[-1])
    count = int(inside.sum())
    if count < FEWEST:
        return None
    at, target = times_s[inside], track[inside]
    source = np.column_stack([np.interp(at, truth_s, truth[:, axis]) for axis in range(2)])
    angle_rad, shift = 0.0, np.zeros(2)
    if way == "rigid":
        from evo.core.geometry import umeyama_alignment  # noqa: PLC0415 - slow to load

        turn, shift, _ = umeyama_alignment(source.T, target.T)
        angle_rad = math.atan2(turn[1, 0], turn[0, 0])
        source = source @ turn.T
    elif way == "shift":
        shift = (target - source).mean(axis=0)
    left = source + shift - target
    return angle_rad, np.asarray(shift), float(np.sqrt((left**2).sum(axis=1).mean())), count
