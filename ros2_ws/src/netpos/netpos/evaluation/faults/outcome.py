"""What became of a fault: figures of a run with it, beside those of the same run without it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from netpos.evaluation.faults.stream import NS
from netpos.evaluation.faults.tracking import Answer
from netpos.evaluation.pairing import Mask, Stamps, Trajectory, pair
from netpos.messages.values import Array, TrackState, TrackStatus

_HOLDS_NS = 2 * NS
_WORSE = 2.0
_FEW = 3
_SETTLES_NS = 15 * NS  # findings that come so long after the end belong to the fault


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One fault in one scenario.

    detected : by what, in words, nothing: (); max_m, rmse_m : horizontal error while it lasts;
    beyond : estimates from its start on that are further from the truth than their protection
    level while the state is TRACKING, of ``tracking``; beyond_without : the same of the run
    without the fault; recovered_s : from its end to the first estimate that opens 2 s of TRACKING
    with errors within twice the 95 % error of the run without it, None: never; missing_during,
    missing_after : estimates that the run without it has and this one has not; finite : whether
    all that was published is; crashed : what ended the tracker
    """

    scenario: str
    fault: str
    applies: bool = True
    detected: tuple[str, ...] = ()
    max_m: float | None = None
    rmse_m: float | None = None
    beyond: int = 0
    tracking: int = 0
    beyond_without: int = 0
    worst_ratio: float | None = None
    recovered_s: float | None = None
    missing_during: int = 0
    missing_after: int = 0
    finite: bool = True
    crashed: str = ""

    @property
    def missed(self) -> bool:
        """Whether TRACKING covered an error beyond the level that is not there without the
        fault."""
        return self.beyond > self.beyond_without

    @property
    def failed(self) -> bool:
        """Whether the tracker ended, or published what is no number."""
        return bool(self.crashed) or not self.finite

    def to_json(self) -> dict[str, Any]:
        """Plain types, keys as the names here."""
        return {**asdict(self), "detected": list(self.detected), "missed": self.missed}


def judged(
    names: tuple[str, str],
    times: tuple[int, int],
    truth: Mapping[str, Trajectory],
    answers: tuple[Answer, Answer],
) -> Outcome:
    """The outcome of a fault.

    names : of the scenario and the fault; times : its start and end [ns]; answers : with and
    without it
    """
    start_ns, end_ns = times
    with_it, without = ([_Scored.of(a, vue, truth[vue]) for vue in truth] for a in answers)
    during = np.concatenate([s.error[s.between(start_ns, end_ns)] for s in with_it])
    usual = np.concatenate([s.error for s in without])
    limit_m = _WORSE * float(np.percentile(usual, 95)) if usual.size else math.inf
    recovered = [s.recovered_s(end_ns, limit_m) for s in with_it]
    recovered_s = [after_s for after_s in recovered if after_s is not None]
    pairs = list(zip(with_it, without, strict=True))
    ratios = np.concatenate([s.ratio[s.stamp_ns >= start_ns] for s in with_it])
    return Outcome(
        scenario=names[0],
        fault=names[1],
        detected=_detected(answers, times, pairs),
        max_m=float(during.max()) if during.size else None,
        rmse_m=float(np.sqrt(np.mean(during**2))) if during.size else None,
        beyond=sum(s.beyond(start_ns) for s in with_it),
        tracking=sum(int(s.tracking[s.stamp_ns >= start_ns].sum()) for s in with_it),
        beyond_without=sum(s.beyond(start_ns) for s in without),
        worst_ratio=float(ratios.max()) if ratios.size else None,
        recovered_s=max(recovered_s) if len(recovered_s) == len(truth) else None,
        missing_during=sum(_missing(a, b, start_ns, end_ns) for a, b in pairs),
        missing_after=sum(_missing(a, b, end_ns, 1 << 62) for a, b in pairs),
        finite=all(s.finite for s in with_it),
        crashed=answers[0].crashed,
    )


@dataclass(frozen=True, slots=True)
class _Scored:
    """Estimates with truth: stamps (n,), errors (n,) m, whether TRACKING, error over level of
    those that are (0: not); and the states of all epochs."""

    stamp_ns: Stamps
    error: Array
    tracking: Mask
    ratio: Array
    statuses: Mapping[int, TrackStatus]
    finite: bool

    @classmethod
    def of(cls, answer: Answer, vue: str, truth: Trajectory) -> _Scored:
        estimate = Trajectory.of(answer.odometry.get(vue, ()))
        pairs = pair(estimate, truth)
        statuses = answer.statuses.get(vue, {})
        stamps, error = pairs.estimate.stamp_ns, pairs.horizontal_error
        own = [statuses.get(int(stamp)) for stamp in stamps]
        tracking = np.array([s is not None and s.state is TrackState.TRACKING for s in own], bool)
        levels = np.array([s.protection_level_m if s is not None else np.inf for s in own])
        ratio = np.where(tracking & (levels > 0.0), error / np.where(levels > 0, levels, 1.0), 0.0)
        finite = not estimate.invalid and all(map(_is_finite, statuses.values()))
        return cls(stamps, error, tracking, ratio, statuses, finite)

    def between(self, start_ns: int, end_ns: int) -> Mask:
        return (self.stamp_ns >= start_ns) & (self.stamp_ns < end_ns)

    def beyond(self, start_ns: int) -> int:
        return int(np.sum(self.ratio[self.stamp_ns >= start_ns] > 1.0))

    def recovered_s(self, end_ns: int, limit_m: float) -> float | None:
        """Seconds until all is well for ``_HOLDS_NS``."""
        good = self.tracking & (self.error <= limit_m)
        begin: int | None = None
        for stamp, fine in zip(self.stamp_ns.tolist(), good.tolist(), strict=True):
            if stamp < end_ns:
                continue
            begin = (stamp if begin is None else begin) if fine else None
            if begin is not None and stamp - begin >= _HOLDS_NS:
                return float(begin - end_ns) / NS
        return None

    def not_tracking_s(self, start_ns: int, end_ns: int) -> dict[str, float]:
        """Seconds from one status to the next by state, without TRACKING."""
        stamps = sorted(s for s in self.statuses if start_ns <= s < end_ns)
        spent: dict[str, float] = {}
        for stamp, after in pairwise([*stamps, end_ns]):
            state = self.statuses[stamp].state
            if state is not TrackState.TRACKING:
                spent[state.name] = spent.get(state.name, 0.0) + (after - stamp) / NS
        return spent


def _is_finite(status: TrackStatus) -> bool:
    places = [v for m in status.modes for v in (m.weight, m.x_m, m.y_m)]
    return all(
        map(math.isfinite, (status.nis, status.position_sd_m, status.protection_level_m, *places))
    )


def _missing(ours: _Scored, theirs: _Scored, start_ns: int, end_ns: int) -> int:
    wanted = theirs.stamp_ns[theirs.between(start_ns, end_ns)]
    return int(np.sum(~np.isin(wanted, ours.stamp_ns)))


def _detected(
    answers: tuple[Answer, Answer],
    times: tuple[int, int],
    pairs: Iterable[tuple[_Scored, _Scored]],
) -> tuple[str, ...]:
    """What noticed the fault, the strongest word first."""
    (with_it, without), (start_ns, end_ns) = answers, times
    found = [
        f"excluded {rsu}"
        for rsu, at_ns in sorted(with_it.excluded.items())
        if at_ns >= start_ns and rsu not in without.excluded
    ]
    refused = with_it.refused - without.refused
    found += [
        f"refused {reason} {count}"
        for reason, count in refused.most_common()
        if count > max(_FEW, without.refused[reason] // 10)
    ]
    until_ns = end_ns + _SETTLES_NS
    for ours, theirs in pairs:
        usual = theirs.not_tracking_s(start_ns, end_ns)
        for state, spent_s in ours.not_tracking_s(start_ns, end_ns).items():
            if spent_s > usual.get(state, 0.0) + 0.5:
                found.append(f"{state} {spent_s:.1f} s")
    said = {
        subject
        for (subject, words), (at_ns, _) in with_it.said.items()
        if start_ns <= at_ns < until_ns and (subject, words) not in without.said
    }
    if said:
        found.append(f"/diagnostics: {', '.join(sorted(said)[:_FEW])}")
    return tuple(found)
