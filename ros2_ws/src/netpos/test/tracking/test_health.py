"""Health of RSUs on simulated streams of gated innovations: liars, turns, bursts, silence."""

from __future__ import annotations

import math
from typing import Any

import pytest
from health_stream import (
    NS_PER_M,
    SD,
    Behaviour,
    Errors,
    Stream,
    first_isolated,
    honest,
    isolated,
    liar,
    ns,
    observe,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from netpos.tracking.health.health import HealthConfig, RsuHealth, RsuState

# honest RSUs


def test_honest_rsus_are_ok() -> None:
    stream = Stream()
    health = stream.run(0, 60, dict.fromkeys("abc", honest))
    assert isolated(health, 60) == set()
    for report in health.reports(ns(60)):
        assert (report.state, report.text) == (RsuState.OK, "ok")
        assert report.accept_ratio > 0.98
        assert report.rate_hz == pytest.approx(10.0)
        assert report.age_s == pytest.approx(0.1)
        assert report.measurements == 580  # the last 2 s are not settled
        assert report.late == 0
        assert abs(report.mean_innovation["toa"]) < 0.2
        assert abs(report.mean_normalised["azimuth"]) < 0.3
    assert [r.rsu_id for r in health.reports(ns(60))] == ["a", "b", "c"]


def test_an_rsu_never_heard() -> None:
    report = RsuHealth().report("x", 0)
    assert (report.state, report.text) == (RsuState.OK, "not heard yet")
    assert (report.age_s, report.accept_ratio) == (-1.0, -1.0)
    assert not RsuHealth().excluded("x", 1)


# liars

LIES = [
    ("azimuth", math.radians(20.0), "isolated: azimuth off by "),
    ("range", 30.0, "isolated: range late by "),
    ("toa", -105 / NS_PER_M, "isolated: clock step of -10"),
]


@pytest.mark.parametrize(("kind", "error", "text"), LIES)
def test_a_steady_liar_is_found_named_and_isolated(kind: str, error: float, text: str) -> None:
    stream = Stream(kinds=("azimuth", "range" if kind == "range" else "toa"))
    rsus = {"a": honest, "b": liar(10.0, **{kind: error}), "c": honest}
    when = first_isolated(stream, rsus, 30)
    assert 14 <= when <= 16
    stream.run(when, 40, rsus)
    assert isolated(stream.health, 40) == {"b"}
    report = stream.health.report("b", ns(40))
    assert report.state is RsuState.EXCLUDED
    assert report.mean_innovation[kind] == pytest.approx(error, abs=0.4 * SD[kind])
    assert report.text.startswith(text)
    for other in "ac":
        assert stream.health.report(other, ns(40)).state is RsuState.OK


def test_the_verdict_holds_from_its_time_on() -> None:
    """A measurement that is applied again is judged as it was the first time."""
    stream = Stream()
    rsus = {"a": honest, "b": liar(10.0, toa=30.0), "c": honest}
    when = first_isolated(stream, rsus, 30)
    assert not stream.health.excluded("b", ns(when) - 1)
    assert stream.health.excluded("b", ns(when))
    stream.run(when, when + 1, rsus)
    assert not stream.health.excluded("b", ns(when) - 1)


def test_a_bias_that_passes_the_gate_is_suspect() -> None:
    stream = Stream()
    rsus = {"a": honest, "b": liar(0, azimuth=2.2 * SD["azimuth"]), "c": honest}
    stream.run(0, 30, rsus)
    report = stream.health.report("b", ns(30))
    assert report.state is RsuState.SUSPECT
    assert report.text.startswith("azimuth off by 3.")
    assert isolated(stream.health, 30) == set()


def test_two_liars_among_five_are_both_isolated() -> None:
    stream = Stream()
    rsus = dict.fromkeys("abcde", honest) | {"b": liar(5, toa=30), "d": liar(5, azimuth=0.35)}
    stream.run(0, 20, rsus)
    assert isolated(stream.health, 20) == {"b", "d"}


def test_two_against_two_isolates_nobody() -> None:
    stream = Stream()
    rsus = dict.fromkeys("abcd", honest) | {"b": liar(5, toa=30), "d": liar(5, azimuth=0.35)}
    assert first_isolated(stream, rsus, 40) == math.inf
    assert stream.health.report("b", ns(40)).state is RsuState.SUSPECT


# what is no evidence


@pytest.mark.parametrize("duration", [0.5, 1.5, 5.0])
@pytest.mark.parametrize("last_accepted", ["", "a"])
def test_a_sharp_turn_isolates_nobody(duration: float, last_accepted: str) -> None:
    """All are refused, or all but one that the track happens to follow."""
    turn = liar(10.3, 10.3 + duration, toa=20.0, azimuth=0.3)
    rsus = dict.fromkeys("abcd", turn) | dict.fromkeys(last_accepted, honest)
    stream = Stream()
    assert first_isolated(stream, rsus, 25) == math.inf
    assert [r.state for r in stream.health.reports(ns(25))] == [RsuState.OK] * 4


def test_bursts_isolate_nobody() -> None:
    """A second and a half of lies every four seconds."""
    stream = Stream()
    rsus = dict.fromkeys("abc", honest)
    rsus["b"] = lambda t, _: {"toa": 30.0} if t % 4.0 < 1.5 else {}
    assert first_isolated(stream, rsus, 60) == math.inf


BURST = {"a": honest, "b": liar(5.0, 7.0, toa=50.0), "c": honest}  # 20 refused in 1.9 s


@pytest.mark.parametrize(
    ("limits", "found"),
    [
        ({"isolate_after_s": 1.9, "isolate_after_count": 20}, True),
        ({"isolate_after_s": 1.900001, "isolate_after_count": 20}, False),
        ({"isolate_after_s": 1.9, "isolate_after_count": 21}, False),
        ({}, False),
    ],
)
def test_length_and_number_at_their_boundary(limits: dict[str, Any], found: bool) -> None:
    stream = Stream(**limits)
    assert (first_isolated(stream, BURST, 15) < math.inf) is found


def test_few_measurements_take_as_long_as_it_takes() -> None:
    """At 2 Hz ten measurements are five seconds."""
    stream = Stream()
    rsus = {"a": honest, "b": liar(10.0, toa=30.0), "c": honest}
    assert first_isolated(stream, rsus, 40, rate=2.0) in {17, 18}


def test_two_rsus_that_contradict_each_other_are_both_suspect() -> None:
    stream = Stream()
    health = stream.run(0, 60, {"a": liar(0, toa=30.0), "b": liar(0, toa=-30.0)})
    assert isolated(health, 60) == set()
    assert {r.state for r in health.reports(ns(60))} == {RsuState.SUSPECT}
    assert health.report("a", ns(60)).text.startswith("0 of 200 accepted: clock step of ")


@pytest.mark.parametrize(("size", "found"), [(1.5, True), (1.65, False)])
def test_a_track_led_astray_is_no_witness(size: float, found: bool) -> None:
    """All but one pass the gate, with a mean squared innovation of 2.25 and 2.72: at most 2.5."""
    health = RsuHealth()
    for k in range(200):
        for name in "abc":
            values = {"azimuth": (size * (-1) ** k, 1.0), "toa": (size, 1.0)}
            observe(health, name, "v", ns(k / 10), name != "b", values)
    assert isolated(health, 20) == ({"b"} if found else set())


def test_a_lone_rsu_is_never_isolated() -> None:
    stream = Stream()
    assert first_isolated(stream, {"a": liar(0, toa=30.0)}, 60) == math.inf


def test_rsus_that_see_other_devices_are_no_witnesses() -> None:
    """Three RSUs, but no device is seen by more than two of them."""
    seen = {"a": {"v", "w"}, "b": {"v", "u"}, "c": {"w", "u"}}
    stream = Stream()

    def only(name: str, errors: Errors) -> Behaviour:
        return lambda _, vue: errors if vue in seen[name] else None

    rsus = {"a": only("a", {"toa": 40.0}), "b": only("b", {}), "c": only("c", {})}
    assert first_isolated(stream, rsus, 40, vues="uvw") == math.inf


@pytest.mark.parametrize(("blocked", "found"), [(1, False), (5, False), (6, True), (10, True)])
def test_many_devices_decide_by_majority(blocked: int, found: bool) -> None:
    """A path blocked for a few devices is theirs; an RSU that most find late is late."""
    vues = [f"v{k}" for k in range(10)]
    late = set(vues[:blocked])
    stream = Stream()
    rsus = dict.fromkeys("abc", honest)
    rsus["b"] = lambda _, vue: {"toa": 105 / NS_PER_M} if vue in late else {}
    stream.run(0, 12, rsus, vues=vues)
    assert isolated(stream.health, 12) == ({"b"} if found else set())
    if found:
        assert stream.health.report("b", ns(12)).text == "isolated: clock step of 105 ns"


# silence


def test_a_silent_rsu_is_suspect_while_its_device_is_heard() -> None:
    stream = Stream()
    rsus = dict.fromkeys("abc", honest)
    stream.run(0, 10, rsus)
    del rsus["b"]
    stream.run(10, 13, rsus)
    assert stream.health.report("b", ns(12.89)).state is RsuState.OK
    report = stream.health.report("b", ns(12.9))
    assert (report.state, report.text) == (RsuState.SUSPECT, "silent for 3 s")
    assert report.age_s == pytest.approx(3.0)
    assert stream.health.report("a", ns(12.9)).text == "ok"
    report = stream.health.report("a", ns(40))
    assert (report.state, report.text) == (RsuState.OK, "no device heard for 27 s")


# whatever the gates say


@settings(max_examples=150, deadline=None)
@given(st.data(), st.integers(2, 6), st.integers(1, 3))
def test_somebody_is_always_trusted(data: Any, rsu_count: int, vue_count: int) -> None:
    """Never fewer than two trusted RSUs of those known once one is isolated, and nothing new is
    isolated while fewer than three are active."""
    config = HealthConfig(
        settle_s=1.0,
        isolate_after_s=0.5,
        isolate_after_count=2,
        readmit_after_s=1.0,
        readmit_after_count=2,
        lapse_s=5.0,
    )
    health, names = RsuHealth(config), "abcdef"[:rsu_count]
    before: set[str] = set()
    states = st.sampled_from("arn")  # accepted, refused, not heard
    active: dict[int, set[str]] = {}
    for slot in range(12):
        active[slot] = set()
        for v in range(vue_count):
            for name, what in zip(
                names,
                data.draw(st.lists(states, min_size=rsu_count, max_size=rsu_count)),
                strict=True,
            ):
                if what != "n":
                    active[slot].add(name)
                    for k in range(3):
                        observe(health, name, f"v{v}", ns(slot + 0.3 * k), what == "a", {})
        now = isolated(health, slot + 1, names)
        if now:
            assert len(set(names) - now) >= 2
        if now - before:
            assert len(active[slot - 1]) >= 3  # the slot that was just judged
        before = now
