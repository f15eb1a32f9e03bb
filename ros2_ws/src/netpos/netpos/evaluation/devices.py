"""Several devices of one recording scored as one, one after another in time."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from netpos.evaluation.availability import refusals
from netpos.evaluation.evaluate import VueEvaluation
from netpos.evaluation.metrics import Figures, Initial, Run, score
from netpos.evaluation.pairing import Stamps, Trajectory
from netpos.evaluation.yardsticks import Observations

_APART_NS = 1_000_000_000_000  # between two devices: no window, gap or silence is that long


@dataclass(frozen=True, slots=True)
class Together:
    """Devices as one. ``run``: of all; ``figures``: of the estimates that count, ``counted_ns``
    their stamps in it; ``offset_ns``: what was added to the stamps of each device, 0 for the
    first."""

    run: Run
    figures: Figures
    counted_ns: Stamps
    offset_ns: Mapping[str, int]

    def observations(self, seen: Mapping[str, Observations]) -> Observations:
        """What was measured of each device, at the stamps of ``run``."""
        parts = [
            replace(seen[name], stamp_ns=seen[name].stamp_ns + offset)
            for name, offset in self.offset_ns.items()
        ]
        names = [f.name for f in dataclasses.fields(Observations)]
        return Observations(
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        )


def together(vues: Mapping[str, VueEvaluation]) -> Together:
    """The devices of an evaluation, at least one, as one.

    Of each device its own first estimates do not count; shares of time are those of the time of
    all, times to a first fix the median, numbers the sum.
    """
    devices = list(vues.values())
    offset_ns = dict(zip(vues, _offsets([device.run for device in devices]), strict=True))
    if len(devices) == 1:
        (only,) = devices
        counted_ns = only.scored.counted.estimate.stamp_ns
        return Together(only.run, only.scored.figures, counted_ns, offset_ns)
    offsets = list(offset_ns.values())
    truth = _joined([device.run.truth for device in devices], offsets)
    estimate = _joined([device.scored.counted.estimate for device in devices], offsets)
    statuses = [
        replace(status, stamp_ns=status.stamp_ns + offset)
        for device, offset in zip(devices, offsets, strict=True)
        for status in device.run.statuses
        if status.stamp_ns >= device.scored.from_ns
    ]
    run = Run(truth=truth, estimate=estimate, statuses=statuses)
    figures = replace(score(run, skip=0).figures, **_of_all(devices))
    return Together(run, figures, estimate.stamp_ns, offset_ns)


def _offsets(runs: Sequence[Run]) -> list[int]:
    """What to add to the stamps of each run, so that it begins long after the one before."""
    offsets, end = [], None
    for run in runs:
        stamps = np.concatenate([run.truth.stamp_ns, run.estimate.stamp_ns])
        offset = 0 if end is None else end + _APART_NS - int(stamps.min())
        offsets.append(offset)
        end = int(stamps.max()) + offset
    return offsets


def _joined(parts: Sequence[Trajectory], offsets: Sequence[int]) -> Trajectory:
    return Trajectory(
        stamp_ns=np.concatenate([p.stamp_ns + o for p, o in zip(parts, offsets, strict=True)]),
        position=np.concatenate([part.position for part in parts]),
        velocity=np.concatenate([part.velocity for part in parts]),
        heading=np.concatenate([part.heading for part in parts]),
        position_cov=np.concatenate([part.position_cov for part in parts]),
    )


def _of_all(devices: Sequence[VueEvaluation]) -> dict[str, Any]:
    """Figures of whole runs, of all devices together."""
    spans = [float(np.ptp(device.run.truth.stamp_ns)) for device in devices]
    received, refused = 0, 0
    for device in devices:
        if device.run.statuses:
            last = max(device.run.statuses, key=lambda status: status.stamp_ns)
            of_it, counted = refusals(last)
            refused, received = refused + of_it, received + counted
    figures = [device.figures for device in devices]
    return {
        "availability": _share([f.availability for f in figures], spans),
        "measured": _share([f.measured for f in figures], spans),
        "unscored_s": sum(f.unscored_s or 0.0 for f in figures),
        "lost_tracks": sum(f.lost_tracks or 0 for f in figures),
        "rejected": sum(f.rejected or 0 for f in figures),
        "rejected_share": refused / received if received else None,
        "initial": Initial(
            time_to_first_fix_s=_median(f.initial.time_to_first_fix_s for f in figures),
            time_to_ready_s=_median(f.initial.time_to_ready_s for f in figures),
            time_to_1m_s=_median(f.initial.time_to_1m_s for f in figures),
        ),
    }


def _share(shares: Sequence[float | None], spans: Sequence[float]) -> float | None:
    """The share of all spans together; None where none has a length."""
    known = [(s, span) for s, span in zip(shares, spans, strict=True) if s is not None]
    total = sum(span for _, span in known)
    return sum(share * span for share, span in known) / total if total else None


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
