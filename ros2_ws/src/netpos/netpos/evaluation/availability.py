"""Times without a usable position: availability, lost tracks, time without an estimate,
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
STAYS = (TrackState.INITIALISING, TrackState.COASTING, TrackState.AMBIGUOUS)


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


def unscored_s(truth_ns: Stamps, scored_ns: Stamps, every_ns: Stamps) -> float:
    """Seconds of the truth's span at which the newest scored estimate is too old, or there is none
    yet.

    It is too old after 0.2 s, or after 1.5 times the median interval of all estimates
    (``every_ns``) where that is longer: of a slow tracker only missing estimates count.
    """
    slot_s = SLOT_S
    if every_ns.size > 1:
        slot_s = max(slot_s, 1.5 * float(np.median(np.diff(every_ns))) / NS)
    span_ns = int(truth_ns[-1] - truth_ns[0])
    return (span_ns - _covered_ns(truth_ns, scored_ns, slot_s)) / NS


def lost_tracks(statuses: Iterable[TrackStatus]) -> int:
    """Number of times a track was lost.

    A track is known from state TRACKING on, also while it says afterwards that it is COASTING,
    AMBIGUOUS or INITIALISING (its sd has grown). A loss is a step from there to WAITING, or a
    loss that the tracker counted (``LOSSES``); a step that was counted too is one loss. Of several
    statuses with one stamp the last counts.
    """
    by_stamp = {status.stamp_ns: status for status in statuses}
    lost, known, counted = 0, False, 0
    for stamp in sorted(by_stamp):
        status = by_stamp[stamp]
        counted_losses = sum(status.rejected.get(reason, 0) for reason in LOSSES)
        was_known = known
        known = status.state == TrackState.TRACKING or (known and status.state in STAYS)
        lost += max(counted_losses - counted, int(was_known and not known))
        counted = counted_losses
    return lost


def refusals(last: TrackStatus) -> tuple[int, int]:
    """Measurements refused, and measurements accepted or refused, up to the ``last`` status; IMU
    samples and events are no measurements."""
    refused = sum(
        number
        for reason, number in last.rejected.items()
        if reason not in LOSSES and not reason.startswith("imu_")
    )
    return refused, last.accepted + refused


def rejected_share(last: TrackStatus) -> float | None:
    """Share of the measurements accepted or refused up to the ``last`` status that were refused;
    None where there were neither."""
    refused, received = refusals(last)
    return refused / received if received else None
