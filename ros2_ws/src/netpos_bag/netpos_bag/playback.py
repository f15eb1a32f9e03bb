"""The order and the moments at which a bag's messages and its /clock are due."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase

from netpos.bags import BagEntry, BagError, BagReader
from netpos.bags.qos import is_latched
from netpos.messages.topics import CLOCK, is_tracker_output

from netpos_bag.parameters import PlayConfig

NS = 1_000_000_000
LATCHED_LEAD_NS = NS  # latched messages this close after the start are published before it
NEVER = (CLOCK, "/parameter_events", "/rosout")  # the player's own or about processes long gone


def _matches(topic: str, patterns: Collection[str]) -> bool:
    return any(fnmatchcase(topic, pattern) for pattern in patterns)


def chosen_topics(available: Collection[str], config: PlayConfig) -> list[str]:
    """Topics to play, sorted.

    Raises
    ------
    BagError  a topic was asked for that the bag does not hold, or nothing is left
    """
    for pattern in config.topics:
        if not any(fnmatchcase(topic, pattern) for topic in available):
            raise BagError(
                f"{config.bag} has no topic {pattern}; it holds {', '.join(sorted(available))}"
            )
    chosen = sorted(
        topic
        for topic in available
        if topic not in NEVER
        and (not config.topics or _matches(topic, config.topics))
        and not _matches(topic, config.exclude_topics)
        and not (config.input_only and is_tracker_output(topic))
    )
    if not chosen:
        raise BagError(
            f"{config.bag}: no topic is left to play; check --topics and --exclude-topics"
        )
    return chosen


@dataclass(frozen=True, slots=True)
class Plan:
    """What to play of a bag, from ``start_ns`` (log time) on."""

    bag: BagReader
    topics: list[str]
    start_ns: int
    clock_step_ns: int

    @classmethod
    def make(cls, bag: BagReader, config: PlayConfig) -> Plan:
        """BagError where nothing is left to play."""
        topics = chosen_topics(bag.topics.keys(), config)
        start_ns = bag.start_ns + round(config.start_offset * NS)
        if start_ns > bag.end_ns:
            seconds = (bag.end_ns - bag.start_ns) / NS
            raise BagError(
                f"--start-offset {config.start_offset} s: the bag lasts {seconds:.3f} s"
            )
        return cls(bag, topics, start_ns, max(1, round(config.rate / config.clock_hz * NS)))

    @property
    def latched(self) -> list[str]:
        """Transient local topics: published first, so that late subscribers know them."""
        return [topic for topic in self.topics if is_latched(self.bag.topics[topic].qos)]

    def leading(self) -> Iterator[BagEntry]:
        """Latched messages up to shortly after the start."""
        if self.latched:
            for entry in self.bag.messages(self.latched):
                if entry.log_time_ns <= self.start_ns + LATCHED_LEAD_NS:
                    yield entry

    def events(self) -> Iterator[tuple[int, BagEntry | None]]:
        """(log time, message) in order from the start; None where a /clock is due."""
        latched = set(self.latched)
        tick_ns = self.start_ns
        for entry in self.bag.messages(self.topics):
            early = entry.log_time_ns <= self.start_ns + LATCHED_LEAD_NS
            if entry.log_time_ns < self.start_ns or (early and entry.topic in latched):
                continue
            while tick_ns <= entry.log_time_ns:
                yield tick_ns, None
                tick_ns += self.clock_step_ns
            yield entry.log_time_ns, entry
        yield tick_ns, None
