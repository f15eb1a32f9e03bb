"""Health of the RSUs, from what the tracks of all devices find: who is silent, who lies.

The evidence against an RSU is comparative. Stamps are cut into slots. In a slot a device speaks
*against* an RSU when its gate refuses nearly all that this RSU says and takes nearly all of at
least two others, which outnumber those it refuses and whose innovations are as small as their sd
promises (a track led astray by two RSUs passes its gate, but not that); it speaks *for* an RSU
when it takes it as it takes another one. Slots against it in a row, long enough and with
measurements enough, isolate an RSU; slots for it, in a row and longer, re-admit it. So a sharp
turn (the others are refused too), a burst, one of many devices with a blocked path, or two RSUs
that contradict each other isolate nobody. RSUs within 1 m of each other are one witness. An RSU
that comes to a track which others hold is on probation first (``probation``).

Everything follows from stamps. A slot is judged in one piece ``settle_s`` after its end, and the
verdict holds for measurements from then on: while no measurement comes later than that, what a
tracker is told does not depend on the order of arrival. A track that goes back in time calls
``rewind`` and observes anew.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum

from netpos.messages.values import RsuMeasurement
from netpos.tracking.estimators.epoch_rows import Source
from netpos.tracking.health.observations import (
    FittedEpoch,
    Observation,
    mean_nis,
    medians,
    off,
    rate_hz,
    words,
)
from netpos.tracking.health.probation import Probation, Vote, independent
from netpos.tracking.rsus.rsu import Rsu

_AGREES, _REFUSED = 0.7, 0.3  # accept ratios
_WITNESS = 2.5  # mean squared normalised innovation; that of a track led astray is larger
_STALE_SLOTS = 10  # a run of verdicts does not survive a longer pause
_FORGET_NS = 60_000_000_000
_SPEAKS = 3  # refused measurements in a run before they are mentioned
_FEW = 20
_AT_ONCE = 64  # epochs kept before they are taken: one after the other costs twice as much
_BIASED = 1.5  # median normalised innovation of an RSU that passes the gate


class RsuState(IntEnum):
    """What the tracker thinks of an RSU."""

    OK = 0
    SUSPECT = 1
    EXCLUDED = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthConfig:
    """When an RSU is excluded, re-admitted and called silent.

    RSUs are compared within a slot: it must be no shorter than their measurement interval. Raises
    ``ValueError`` for values that are not finite and > 0.
    """

    slot_s: float = 1.0
    settle_s: float = 2.0
    isolate_after_s: float = 2.0
    isolate_after_count: int = 10
    readmit_after_s: float = 5.0
    readmit_after_count: int = 20
    lapse_s: float = 30.0  # without any trusted RSU: nothing to compare with
    silent_after_s: float = 3.0
    window: int = 200  # measurements behind the figures of a report

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{entry.name} must be finite and > 0, got {value!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RsuReport:
    """Figures of one RSU for the operator; all but ``age_s`` are ``settle_s`` behind.

    ``age_s`` since it was last heard, -1: never; ``accept_ratio`` over the last ``window``
    measurements, -1: none; medians of the innovation (m, rad) and of innovation / sd by kind,
    of the measurements since it began to be refused where it is.
    """

    rsu_id: str
    state: RsuState
    text: str
    age_s: float = -1.0
    rate_hz: float = 0.0
    accept_ratio: float = -1.0
    measurements: int = 0
    late: int = 0
    mean_innovation: Mapping[str, float] = field(default_factory=dict)
    mean_normalised: Mapping[str, float] = field(default_factory=dict)


@dataclass(slots=True)
class Run:
    """Verdicts of one sign in a row: first and last stamp and number of their measurements."""

    first_ns: int
    last_ns: int
    count: int

    def reaches(self, duration_s: float, count: int) -> bool:
        """Whether it is long enough, in time and measurements."""
        return self.last_ns - self.first_ns >= duration_s * 1e9 and self.count >= count


@dataclass(slots=True)
class RsuMemory:
    """One RSU: what was found of it lately, and the verdicts so far."""

    window: deque[Observation]
    last_ns: int = -1
    last_vue: str = ""
    measurements: int = 0
    late: int = 0
    excluded: bool = False
    cause: str = ""
    against: Run | None = None
    agrees: Run | None = None
    changes: deque[tuple[int, bool]] = field(default_factory=lambda: deque(maxlen=16))


class RsuHealth:
    """Collects observations of all tracks, reports and isolates RSUs."""

    def __init__(
        self,
        config: HealthConfig | None = None,
        rsus: Mapping[str, Rsu] | None = None,
        *,
        probation: bool = False,
    ) -> None:
        """``rsus``: where they are, as far as known; ``probation``: new ones have to prove
        themselves."""
        self._config = config or HealthConfig()
        self._known: Mapping[str, Rsu] = {} if rsus is None else rsus
        self._with_probation = probation
        self._slot_ns = int(self._config.slot_s * 1e9)
        self._settle_ns = int(self._config.settle_s * 1e9)
        self.reset()

    def reset(self) -> None:
        """Forget everything: the clock jumped back."""
        # By slot, then by device and RSU, then by stamp.
        self._open: dict[int, dict[tuple[str, str], dict[int, Observation]]] = {}
        self._rsus: dict[str, RsuMemory] = {}
        self._heard_of: list[FittedEpoch] = []  # not yet taken
        self._heard: dict[str, int] = {}  # newest stamp by device
        self._judged = -(1 << 62)  # slots below are judged
        self._due_ns = -(1 << 62)  # when the next one is
        self._trusted_ns = 0
        self._accused = False  # an RSU is, or was, excluded
        self._probation = Probation(self._slot_ns, self._settle_ns)

    def hear(self, epoch: FittedEpoch) -> None:
        """Take what a track found of an epoch; of an excluded RSU: what the gate would have said.
        A second observation of the same RSU, device and stamp replaces the first."""
        if epoch.stamp_ns >= self._due_ns:
            self._advance(epoch.stamp_ns)
        self._heard_of.append(epoch)
        if len(self._heard_of) >= _AT_ONCE:
            self._catch_up()

    def _catch_up(self) -> None:
        """Take the epochs heard."""
        heard, self._heard_of = self._heard_of, []
        for epoch in heard:
            self._take(epoch.vue_id, epoch.stamp_ns, epoch.observations())

    def _take(self, vue_id: str, stamp_ns: int, found: Iterable[tuple[str, Observation]]) -> None:
        slot = stamp_ns // self._slot_ns
        late = slot < self._judged
        if not late and stamp_ns > self._heard.get(vue_id, -1):
            self._heard[vue_id] = stamp_ns
        streams = {} if late else self._open.setdefault(slot, {})
        for rsu_id, seen in found:
            rsu = self._rsus.get(rsu_id)
            if rsu is None:
                rsu = self._rsus[rsu_id] = RsuMemory(deque(maxlen=self._config.window))
            if late:
                rsu.late += 1
                continue
            if stamp_ns >= rsu.last_ns:
                rsu.last_ns, rsu.last_vue = stamp_ns, vue_id
            stream = streams.get((vue_id, rsu_id))
            if stream is None:
                stream = streams[vue_id, rsu_id] = {}
            stream[stamp_ns] = seen

    def rewind(self, vue_id: str, stamp_ns: int) -> None:
        """Drop what was observed of a device from ``stamp_ns`` on, as far as it is not judged: its
        track goes back and will observe anew."""
        self._catch_up()
        for slot, streams in self._open.items():
            if (slot + 1) * self._slot_ns > stamp_ns:
                for key in [k for k in streams if k[0] == vue_id]:
                    kept = {t: entry for t, entry in streams[key].items() if t < stamp_ns}
                    if kept:
                        streams[key] = kept
                    else:
                        del streams[key]

    def sort_out(
        self, stamp_ns: int, items: list[Source], agrees: Callable[[RsuMeasurement], bool]
    ) -> tuple[list[Source], list[RsuMeasurement]]:
        """What of an epoch may be fused, and what is only looked at: that of an excluded RSU, and
        of one on probation where it does not agree with the prediction (``agrees``)."""
        if stamp_ns >= self._due_ns:
            self._advance(stamp_ns)
        if not (self._accused or self._probation.any):
            return items, []
        used: list[Source] = []
        watched: list[RsuMeasurement] = []
        for item in items:
            if isinstance(item, RsuMeasurement) and (
                self.excluded(item.rsu_id, stamp_ns)
                or (self.is_on_probation(item.rsu_id, item.vue_id, stamp_ns) and not agrees(item))
            ):
                watched.append(item)
            else:
                used.append(item)
        return used, watched

    def is_on_probation(self, rsu_id: str, vue_id: str, stamp_ns: int) -> bool:
        """Whether an RSU is too new to have a vote in a measurement of this device and stamp."""
        return self._with_probation and self._probation.holds(rsu_id, vue_id, stamp_ns)

    def excluded(self, rsu_id: str, stamp_ns: int) -> bool:
        """Whether a measurement of this RSU with this stamp is to be refused."""
        if stamp_ns >= self._due_ns:
            self._advance(stamp_ns)
        rsu = self._rsus.get(rsu_id)
        if rsu is None:
            return False
        for effective_ns, excluded in reversed(rsu.changes):
            if effective_ns <= stamp_ns:
                return excluded
        return False

    # judgement

    def _advance(self, now_ns: int) -> None:
        """Judge the slots that ended ``settle_s`` ago."""
        closed = (now_ns - self._settle_ns) // self._slot_ns
        if closed <= self._judged:
            return
        self._catch_up()
        self._judged = closed
        self._due_ns = (closed + 1) * self._slot_ns + self._settle_ns
        for slot in sorted(s for s in self._open if s < closed):
            self._judge(self._open.pop(slot), (slot + 1) * self._slot_ns)
        self._heard = {v: t for v, t in self._heard.items() if t > now_ns - _FORGET_NS}
        self._probation.forget(self._heard.keys())

    def _judge(
        self, streams: Mapping[tuple[str, str], Mapping[int, Observation]], end_ns: int
    ) -> None:
        devices: dict[str, dict[str, Vote]] = {}
        heard: dict[str, list[Observation]] = {}
        for (vue_id, rsu_id), stream in streams.items():
            entries = list(stream.values())
            ratio = sum([e.accepted for e in entries]) / len(entries)
            devices.setdefault(vue_id, {})[rsu_id] = Vote(entries, ratio, mean_nis(entries))
            heard.setdefault(rsu_id, []).extend(entries)
        for rsu_id, entries in heard.items():
            rsu = self._rsus[rsu_id]
            rsu.window.extend(sorted(entries))
            rsu.measurements += len(entries)
            if not rsu.excluded:
                self._trusted_ns = max(self._trusted_ns, rsu.window[-1].stamp_ns)
        against: dict[str, list[Vote]] = {}
        agree: dict[str, list[Vote]] = {}
        for vue_id, votes in devices.items():
            taken = self._compare(votes, against, agree)
            if self._with_probation:
                self._probation.judge(vue_id, votes, taken, end_ns, self._known)
        for rsu_id in sorted(against.keys() | agree.keys()):
            self._extend(rsu_id, against.get(rsu_id, []), agree.get(rsu_id, []))
        self._decide(against, end_ns)

    def _compare(
        self,
        votes: Mapping[str, Vote],
        against: dict[str, list[Vote]],
        agree: dict[str, list[Vote]],
    ) -> frozenset[str]:
        """Sort what one device says of the RSUs into votes against and for them; those it
        takes."""
        trusted = [name for name in votes if not self._rsus[name].excluded]
        fitting = frozenset(
            name
            for name in trusted
            if votes[name].ratio >= _AGREES and votes[name].mean_nis <= _WITNESS
        )
        old = [name for name in trusted if not self._is_held(name, votes[name])]
        taken = fitting.intersection(old)
        refused = [name for name in old if votes[name].ratio <= _REFUSED]
        witnesses = independent(votes, taken, self._known)
        needed = max(2, independent(votes, refused, self._known) + 1)
        for name, vote in votes.items():
            vote.witnesses = taken - {name}
            if vote.ratio >= _AGREES and vote.witnesses:
                agree.setdefault(name, []).append(vote)
            elif vote.ratio <= _REFUSED and witnesses >= needed:
                against.setdefault(name, []).append(vote)
        return fitting

    def _is_held(self, rsu_id: str, vote: Vote) -> bool:
        """Whether an RSU was on probation in a slot."""
        newest = vote.entries[-1]
        return self.is_on_probation(rsu_id, newest.vue_id, newest.stamp_ns)

    def _extend(self, rsu_id: str, against: list[Vote], agree: list[Vote]) -> None:
        """Lengthen the run of verdicts the majority of devices is for, end the other."""
        rsu = self._rsus[rsu_id]
        if len(against) >= len(agree):
            rsu.agrees = None
        if len(against) > len(agree):
            rsu.against = self._longer(rsu.against, against, False)
            rsu.cause = words([e for e in self._since_refused(rsu) if not e.accepted])
        elif len(agree) > len(against):
            rsu.against = None
            rsu.agrees = self._longer(rsu.agrees, agree, True)

    def _longer(self, run: Run | None, votes: Iterable[Vote], accepted: bool) -> Run:
        stamps = [e.stamp_ns for vote in votes for e in vote.entries if e.accepted is accepted]
        first, last = min(stamps), max(stamps)
        if run is None or first - run.last_ns > _STALE_SLOTS * self._slot_ns:
            return Run(first, last, len(stamps))
        return Run(run.first_ns, last, run.count + len(stamps))

    def _decide(self, against: Mapping[str, list[Vote]], end_ns: int) -> None:
        cfg = self._config
        for rsu in self._rsus.values():
            if not rsu.excluded:
                continue
            consistent = rsu.agrees is not None and rsu.agrees.reaches(
                cfg.readmit_after_s, cfg.readmit_after_count
            )
            if consistent or end_ns - self._trusted_ns > cfg.lapse_s * 1e9:
                self._set(rsu, False, end_ns)
        accused: list[tuple[int, str]] = []
        for name in against:
            run = self._rsus[name].against
            if run is not None and run.reaches(cfg.isolate_after_s, cfg.isolate_after_count):
                accused.append((-run.count, name))
        for _, name in sorted(accused):
            if not self._rsus[name].excluded and any(
                sum(not self._rsus[w].excluded for w in vote.witnesses) >= 2
                for vote in against[name]
            ):
                self._set(self._rsus[name], True, end_ns)

    def _set(self, rsu: RsuMemory, excluded: bool, end_ns: int) -> None:
        rsu.excluded = excluded
        self._accused = True
        rsu.agrees = None
        if not excluded:
            rsu.against = None
        rsu.changes.append((end_ns + self._settle_ns, excluded))

    # reports

    def reports(self, now_ns: int) -> list[RsuReport]:
        """Reports of all RSUs heard so far, by name."""
        self._catch_up()
        return [self.report(rsu_id, now_ns) for rsu_id in sorted(self._rsus)]

    def report(self, rsu_id: str, now_ns: int) -> RsuReport:
        """State of one RSU at ``now_ns`` by any clock, and in words what is wrong with it; changes
        nothing."""
        self._catch_up()
        rsu = self._rsus.get(rsu_id)
        if rsu is None or rsu.last_ns < 0:
            return RsuReport(rsu_id=rsu_id, state=RsuState.OK, text="not heard yet")
        age_s = max(now_ns - rsu.last_ns, 0) * 1e-9
        entries = self._since_refused(rsu)
        ratio = -1.0
        if rsu.window:
            ratio = sum(e.accepted for e in rsu.window) / len(rsu.window)
        state, text = self._verdict(rsu_id, now_ns, age_s, entries)
        return RsuReport(
            rsu_id=rsu_id,
            state=state,
            text=text,
            age_s=age_s,
            rate_hz=rate_hz(rsu.window),
            accept_ratio=ratio,
            measurements=rsu.measurements,
            late=rsu.late,
            mean_innovation=medians(entries),
            mean_normalised=medians(entries, normalised=True),
        )

    def _since_refused(self, rsu: RsuMemory) -> list[Observation]:
        first_ns = rsu.against.first_ns if rsu.against is not None else -1
        return [e for e in rsu.window if e.stamp_ns >= first_ns]

    def _verdict(
        self, rsu_id: str, now_ns: int, age_s: float, entries: list[Observation]
    ) -> tuple[RsuState, str]:
        rsu, faults = self._rsus[rsu_id], []
        silent = age_s >= self._config.silent_after_s
        newest_ns = self._heard.get(rsu.last_vue, -1)
        if silent and newest_ns > max(rsu.last_ns, now_ns - self._config.silent_after_s * 1e9):
            faults.append(f"silent for {age_s:.0f} s")
        if rsu.excluded:
            faults.insert(0, f"isolated: {rsu.cause}")
            if rsu.agrees is not None:
                consistent_s = (rsu.agrees.last_ns - rsu.agrees.first_ns) * 1e-9
                faults.append(f"consistent again for {consistent_s:.0f} s")
            return RsuState.EXCLUDED, "; ".join(faults)
        if rsu.window and self.is_on_probation(rsu_id, rsu.last_vue, rsu.last_ns):
            faults.append("new: used where it agrees with the RSUs that track already")
        if rsu.against is not None and rsu.against.count >= _SPEAKS:
            faults.append(rsu.cause)
        elif len(entries) >= _FEW:
            accepted = sum(e.accepted for e in entries)
            if 2 * accepted < len(entries):
                faults.append(f"{accepted} of {len(entries)} accepted: {words(entries)}")
            else:
                faults.extend(off(entries, _BIASED))
        if faults:
            return RsuState.SUSPECT, "; ".join(faults)
        return RsuState.OK, f"no device heard for {age_s:.0f} s" if silent else "ok"
