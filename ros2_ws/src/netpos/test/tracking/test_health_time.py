"""Health of RSUs over time: re-admission, late and repeated observations, forgetting."""

from __future__ import annotations

import pickle
from collections.abc import Iterable
from typing import Any

import numpy as np
from health_stream import (
    Stream,
    honest,
    isolated,
    liar,
    ns,
    observe,
)
from netpos.tracking.health.health import RsuHealth


def test_an_rsu_that_is_consistent_again_is_readmitted() -> None:
    stream = Stream()
    rsus = {"a": honest, "b": liar(5.0, 20.0, azimuth=0.35), "c": honest}
    stream.run(0, 24, rsus)
    assert isolated(stream.health, 24) == {"b"}
    text = stream.health.report("b", ns(24)).text
    assert text.startswith("isolated: azimuth off by ")
    assert text.endswith("; consistent again for 2 s")
    back = next(t for t in range(25, 40) if not isolated(stream.run(t - 1, t, rsus), t))
    assert 27 <= back <= 29  # 5 s of consistent slots, 2 s to settle
    stream.run(back, 60, rsus)
    assert stream.health.report("b", ns(60)).text == "ok"


def test_a_lie_now_and_then_keeps_it_isolated() -> None:
    stream = Stream()
    rsus = dict.fromkeys("abc", honest)
    rsus["b"] = lambda t, _: {"toa": 30.0} if t < 15.0 or t % 5.0 < 2.0 else {}
    stream.run(0, 15, rsus)
    for t in range(15, 60):
        stream.run(t, t + 1, rsus)
        assert isolated(stream.health, t + 1) == {"b"}


def test_isolation_lapses_with_nothing_to_compare_with() -> None:
    """The others have gone: refusing the only RSU would be no comparison any more."""
    stream = Stream()
    rsus = {"a": honest, "b": liar(5.0, toa=30.0), "c": honest}
    stream.run(0, 20, rsus)
    assert isolated(stream.health, 20) == {"b"}
    alone = {"b": rsus["b"]}
    stream.run(20, 51, alone)
    assert isolated(stream.health, 51) == {"b"}
    stream.run(51, 52, alone)
    assert isolated(stream.health, 52) == set()  # more than 30 s at the end of a slot, settled


def test_order_of_arrival_does_not_matter() -> None:
    """Shuffled within a second, with rewound and repeated observations: the same answers."""
    rng = np.random.default_rng(9)
    records = []
    for k in range(400):
        for name in "abcd":
            lies = name == "b" and 8 <= k / 10 < 22
            value = float(rng.normal(0, 0.5) + 30.0 * lies)
            records.append((k / 10, name, abs(value) < 2.0, {"range": (value, 0.5)}))

    def answers(order: Iterable[int], wrong_first: bool) -> list[Any]:
        health = RsuHealth()
        seen = set()
        for i in order:
            t, name, accepted, values = records[i]
            if wrong_first:
                observe(health, name, "v", ns(t), not accepted, {"range": (99.0, 1.0)})
                health.rewind("w", 0)
            observe(health, name, "v", ns(t), accepted, values)
            seen.add((t, health.excluded("b", ns(t))))
        health.excluded("a", ns(60))
        return [sorted(seen), *health.reports(ns(45))]

    straight = answers(range(len(records)), False)
    assert {flag for _, flag in straight[0]} == {False, True}
    arrival = [t + float(rng.uniform(0, 1.0)) for t, *_ in records]
    shuffled = [int(i) for i in np.argsort(arrival)]
    assert answers(shuffled, False) == straight
    assert answers(shuffled, True) == straight


def test_rewind_drops_one_device_from_a_stamp_on() -> None:
    health = RsuHealth()
    for vue in "vw":
        for k in range(20):
            observe(health, "a", vue, ns(k / 10), True, {})
    health.rewind("v", ns(0.75))
    health.excluded("a", ns(10))
    assert health.report("a", ns(10)).measurements == 8 + 20


def test_too_late_is_counted() -> None:
    health = RsuHealth()
    observe(health, "a", "v", ns(10.0), True, {})
    observe(health, "a", "v", ns(7.999), False, {})
    observe(health, "a", "v", ns(8.0), False, {})
    health.excluded("a", ns(20))
    report = health.report("a", ns(20))
    assert (report.late, report.measurements, report.accept_ratio) == (1, 2, 0.5)


def test_reports_change_nothing() -> None:
    """The clock of whoever asks is not that of the stamps."""
    stream, asked = Stream(), Stream()
    rsus = {"a": honest, "b": liar(3.0, toa=30.0), "c": honest}
    for t in range(12):
        stream.run(t, t + 1, rsus)
        asked.run(t, t + 1, rsus)
        asked.health.reports(ns(1e6))
    assert asked.health.reports(ns(12)) == stream.health.reports(ns(12))


def test_reset_forgets() -> None:
    stream = Stream()
    rsus = {"a": honest, "b": liar(0.0, toa=30.0), "c": honest}
    stream.run(100, 120, rsus)
    assert isolated(stream.health, 120) == {"b"}
    stream.health.reset()
    assert stream.health.reports(ns(120)) == []
    assert isolated(stream.run(0, 2, rsus), 2) == set()


def test_memory_is_bounded() -> None:
    def size(seconds: int) -> int:
        stream = Stream(3)
        for t in range(seconds):
            stream.run(t, t + 1, dict.fromkeys("abc", honest), vues=[f"v{t}"])
        return len(pickle.dumps(stream.health))

    assert size(300) < 1.1 * size(100)
