"""The tracker under a stream, with the ticks of the node that holds it."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from netpos.evaluation.faults.of_networks import of_bytes
from netpos.evaluation.faults.stream import NS, Arrival, Order, Stream
from netpos.messages.values import ImuSample, Odometry, RsuInfo, TrackStatus
from netpos.tracking.config import TrackerConfig
from netpos.tracking.health.diagnosis import Level
from netpos.tracking.health.health import RsuState
from netpos.tracking.ordering.sequencer import Item
from netpos.tracking.report import TrackOutput
from netpos.tracking.tracker import Tracker

_STALE_NS = 3 * NS
_QUIET_NS = 2 * NS
NO_MESSAGE = "no message"
NO_INFO = "RsuInfo"
_NUMBER = re.compile(r"[-+]?\d[\d.e+-]*")


@dataclass(slots=True)
class Answer:
    """What a tracker gave out, in order, and what it said of its input.

    said : sentences of /diagnostics at WARN or ERROR without their numbers, by the subject, each
        with the time it was first said; excluded : RSUs set aside, and when first;
    refused : refused or rejected, by reason; crashed : the error that ended it, "" where none did
    """

    odometry: dict[str, list[Odometry]] = field(default_factory=lambda: defaultdict(list))
    statuses: dict[str, dict[int, TrackStatus]] = field(default_factory=lambda: defaultdict(dict))
    said: dict[tuple[str, str], tuple[int, str]] = field(default_factory=dict)
    excluded: dict[str, int] = field(default_factory=dict)
    refused: Counter[str] = field(default_factory=Counter)
    crashed: str = ""


def answer_to(
    stream: Stream, config: TrackerConfig, scene: Mapping[str, RsuInfo], watched: Iterable[str]
) -> Answer:
    """Feed a tracker with all that arrives, as its node does: it looks at its diagnostics once a
    second, tells of silent devices and gives out what waits when nothing comes for 2 s."""
    node = _Node(config, scene, frozenset(watched))
    try:
        for arrival in stream:
            node.tick_until(arrival.at_ns)
            node.take(arrival)
        node.end()
    except Exception as error:
        node.answer.crashed = f"{type(error).__name__}: {error}"
    return node.answer


class _Node:
    def __init__(
        self, config: TrackerConfig, scene: Mapping[str, RsuInfo], watched: frozenset[str]
    ) -> None:
        self.answer = Answer()
        self._config, self._watched = config, watched
        self._latched = dict(scene)
        self._next_ns = self._heard_ns = 0
        self._start()

    def _start(self) -> None:
        self._tracker: Tracker | None = Tracker(self._config)
        self._told: dict[str, int] = {}
        self._newest: dict[str, TrackStatus] = {}
        for info in self._latched.values():
            self._tracker.add_rsu(info)

    def take(self, arrival: Arrival) -> None:
        what = arrival.what
        if isinstance(what, RsuInfo):
            self._latched[what.rsu_id] = what
        if what is Order.START:
            self._start()
        tracker = self._tracker
        if tracker is None:
            return
        match what:
            case Order.CRASH:
                self._count()
                self._tracker = None
            case Order.CLOCK_BACK:
                tracker.reset()
            case RsuInfo():
                try:
                    tracker.add_rsu(what)
                except ValueError:
                    self.answer.refused[NO_INFO] += 1
            case bytes():
                self._add_bytes(tracker, what, arrival.at_ns)
            case Order.START:
                pass
            case _:
                self._add(tracker, what, arrival.at_ns)

    def _add_bytes(self, tracker: Tracker, cdr: bytes, at_ns: int) -> None:
        try:
            item = of_bytes(cdr)
        except Exception:
            self.answer.refused[NO_MESSAGE] += 1
            return
        self._add(tracker, item, at_ns)

    def _add(self, tracker: Tracker, item: Item | ImuSample, at_ns: int) -> None:
        self._heard_ns = at_ns
        tracker.add(item)
        self._publish(tracker.process(), at_ns)

    def _publish(self, outputs: Iterable[TrackOutput], at_ns: int) -> None:
        for output in outputs:
            status = output.status
            self._told[status.vue_id], self._newest[status.vue_id] = at_ns, status
            if status.vue_id not in self._watched:
                continue
            self.answer.statuses[status.vue_id][status.stamp_ns] = status
            if output.odometry is not None:
                self.answer.odometry[status.vue_id].append(output.odometry)

    def tick_until(self, at_ns: int) -> None:
        if not self._next_ns:
            self._next_ns = at_ns + NS
        while self._next_ns <= at_ns:
            if self._tracker is not None:
                self._tick(self._tracker, self._next_ns)
            self._next_ns += NS

    def _tick(self, tracker: Tracker, now_ns: int) -> None:
        quiet_ns = now_ns - self._heard_ns
        if quiet_ns >= _QUIET_NS:
            self._publish(tracker.flush(), now_ns)
        silent_s = {
            vue: (now_ns - at_ns) / NS
            for vue, at_ns in self._told.items()
            if now_ns - at_ns >= _STALE_NS
        }
        for vue in self._watched & silent_s.keys():
            coasting = tracker.coasting(vue, now_ns)
            if coasting is not None:
                self.answer.statuses[vue].setdefault(coasting.status.stamp_ns, coasting.status)
        unheard_s = quiet_ns / NS if quiet_ns >= _STALE_NS else 0.0
        for finding in tracker.findings(self._newest, silent_s, unheard_s):
            if finding.level is not Level.OK:
                words = _NUMBER.sub("#", finding.message)
                key = finding.subject, words
                self.answer.said.setdefault(key, (now_ns, finding.message))
        for report in tracker.rsu_reports(unheard_s):
            if report.state is RsuState.EXCLUDED:
                self.answer.excluded.setdefault(report.rsu_id, now_ns)

    def end(self) -> None:
        if self._tracker is not None:
            self._publish(self._tracker.flush(), self._next_ns)
            self._count()

    def _count(self) -> None:
        if self._tracker is not None:
            for vue, counts in self._tracker.rejected().items():
                if vue in self._watched:
                    self.answer.refused.update(counts)
