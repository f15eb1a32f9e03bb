"""When a device had no usable position: availability, lost tracks, time without an estimate,
refused measurements.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from netpos.evaluation.pairing import Stamps, Trajectory
from netpos.messages.values import TrackState, TrackStatus

SLOT_S = 0.2
NS = 1e9
LOSSES = ("track_lost", "diverged")
EVENTS = (*LOSSES, "sector_corrected")  # counted among the rejections, but no measurements


def ready_stamps(estimate: Trajectory, statuses: Iterable[TrackStatus]) -> Stamps:
    """Stamps of ready estimates: state TRACKING at that stamp; every estimate where the recording
    has no track status at all.
    """
    states = {status.stamp_ns: status.state for status in statuses}
    if not states:
        return estimate.stamp_ns
    ready = [states.get(int(stamp)) is TrackState.TRACKING for stamp in estimate.stamp_ns]
    return estimate.stamp_ns[np.array(ready, dtype=np.bool_)]


def availability(truth_ns: Stamps, ready_ns: Stamps, slot_s: float = SLOT_S) -> float | None:
    """Share of the truth's span at which the newest ready estimate is at most ``slot_s`` old;
    None where the span has no length.
    """
    if truth_ns.size < 2:
        return None
    return _covered_ns(truth_ns, ready_ns, slot_s) / int(truth_ns[-1] - truth_ns[0])


def _covered_ns(truth_ns: Stamps, stamps: Stamps, slot_s: float) -> int:
    """Nanoseconds of the truth's span that begin at most ``slot_s`` after one of ``stamps``."""
    begin, end = int(truth_ns[0]), int(truth_ns[-1])
    starts = np.clip(stamps, begin, end)
    valid_until = np.clip(stamps + round(slot_s * NS), begin, end)
    next_start = np.append(starts[1:], end)
    return int(np.maximum(np.minimum(valid_until, next_start) - starts, 0).sum())


def uncovered_s(truth_ns: Stamps, stamps: Stamps, slot_s: float = SLOT_S) -> float:
    """Seconds of the truth's span at which the newest of ``stamps`` is more than ``slot_s`` old,
    or there is none yet.
    """
    span_ns = int(truth_ns[-1] - truth_ns[0])
    return (span_ns - _covered_ns(truth_ns, stamps, slot_s)) / NS


def lost_tracks(statuses: Iterable[TrackStatus]) -> int:
    """Number of times a track was lost.

    A track is usable from state TRACKING on, also while it is COASTING after that. A loss is a
    step from usable to WAITING or INITIALISING, or a loss that the tracker counted (``LOSSES``); a
    step that was counted too is one loss. Of several statuses with one stamp the last counts.
    """
    by_stamp = {status.stamp_ns: status for status in statuses}
    lost, usable, counted = 0, False, 0
    for stamp in sorted(by_stamp):
        status = by_stamp[stamp]
        told = sum(status.rejected.get(reason, 0) for reason in LOSSES)
        was_usable = usable
        usable = status.state == TrackState.TRACKING or (
            usable and status.state == TrackState.COASTING
        )
        lost += max(told - counted, int(was_usable and not usable))
        counted = told
    return lost


def rejected_share(last: TrackStatus) -> float | None:
    """Share of the measurements accepted or refused up to the ``last`` status that were refused;
    None where there were neither. IMU samples and events are no measurements.
    """
    refused = sum(
        number
        for reason, number in last.rejected.items()
        if reason not in EVENTS and not reason.startswith("imu_")
    )
    received = last.accepted + refused
    return refused / received if received else None
