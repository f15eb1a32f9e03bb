"""What an operator is told of devices, RSUs, what is learned of them, and the input as a whole."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from netpos.messages.values import RsuErrors, StepCalibration, TrackMode, TrackState, TrackStatus
from netpos.tracking.door.refusals import Refused
from netpos.tracking.health.diagnosis import Level, errors_in_words, of_device, of_network, of_rsus
from netpos.tracking.health.health import RsuReport, RsuState
from netpos.tracking.ordering.clocks import Stranger

STATUS = TrackStatus(
    stamp_ns=1_000_000_000,
    vue_id="vue_1",
    state=TrackState.TRACKING,
    nis=1.25,
    nis_dof=4,
    accepted=9,
    rejected={"late": 2, "gate": 1},
    position_sd_m=0.5,
    protection_level_m=2.25,
)
REPORT = RsuReport(
    rsu_id="b",
    state=RsuState.EXCLUDED,
    text="isolated: azimuth off by 20.1 deg",
    age_s=0.25,
    rate_hz=10.0,
    accept_ratio=0.125,
    measurements=80,
    mean_innovation={"azimuth": 0.351},
    mean_normalised={"azimuth": 12.0},
)
ALL = Refused({"variance": 50}, 50, 50, "variance: range_var is 0 m^2; send one from 1 to 2")
SOME = replace(ALL, last=3)
ONCE = replace(ALL, last=0)


@pytest.mark.parametrize(
    ("state", "reason", "level", "message"),
    [
        (TrackState.WAITING, "waits for a pose", Level.WARN, "waiting: waits for a pose"),
        (TrackState.WAITING, "", Level.WARN, "waiting"),
        (TrackState.INITIALISING, "sd 9 m", Level.WARN, "initialising: sd 9 m"),
        (TrackState.TRACKING, "", Level.OK, "tracking"),
        (TrackState.COASTING, "nothing taken", Level.ERROR, "coasting: nothing taken"),
    ],
)
def test_a_device(state: TrackState, reason: str, level: Level, message: str) -> None:
    found = of_device(replace(STATUS, state=state, reason=reason))
    assert (found.level, found.message) == (level, message)
    assert (found.subject, found.hardware_id) == ("vue_1", "vue_1")
    assert found.values == {
        "position_sd_m": "0.500",
        "protection_level_m": "2.250",
        "nis": "1.250",
        "nis_dof": "4",
        "accepted": "9",
        "rejected: gate": "1",
        "rejected: late": "2",
    }


@pytest.mark.parametrize(
    ("refused", "level", "words"),
    [
        (ALL, Level.ERROR, f"; all refused: {ALL.sentence}"),
        (SOME, Level.WARN, f"; 3 of the last 50 refused: {ALL.sentence}"),
        (ONCE, Level.OK, ""),
        (None, Level.OK, ""),
    ],
)
def test_a_device_of_which_something_is_refused(
    refused: Refused | None, level: Level, words: str
) -> None:
    found = of_device(STATUS, refused)
    assert (found.level, found.message) == (level, f"tracking{words}")


def test_what_is_refused_is_said_once() -> None:
    waiting = replace(STATUS, state=TrackState.WAITING, reason=ALL.words())
    found = of_device(waiting, ALL)
    assert (found.level, found.message) == (Level.ERROR, f"waiting: {ALL.words()}")


def test_a_silent_device() -> None:
    found = of_device(STATUS, None, 12.2)
    assert (found.level, found.message) == (Level.STALE, "silent for 12 s; was tracking")


def test_the_places_of_an_ambiguous_device() -> None:
    modes = (TrackMode(weight=0.62, x_m=3.14, y_m=-4.0), TrackMode(weight=0.38, x_m=9.0, y_m=7.0))
    found = of_device(replace(STATUS, state=TrackState.AMBIGUOUS, modes=modes, reason="two"))
    assert found.level is Level.WARN
    assert found.message == "ambiguous: 62 % at (3.1, -4.0) m, 38 % at (9.0, 7.0) m"


def test_what_is_known_of_the_steps() -> None:
    both = StepCalibration(
        length_factor=1.08,
        length_factor_sd=0.02,
        heading_offset_rad=-0.1,
        heading_offset_sd_rad=0.03,
    )
    for steps, said in (
        (both, {"length_factor": "1.080 +- 0.020", "heading_offset_rad": "-0.100 +- 0.030"}),
        (replace(both, heading_offset_sd_rad=0.0), {"length_factor": "1.080 +- 0.020"}),
        (StepCalibration(), {}),
    ):
        values = of_device(replace(STATUS, steps=steps)).values
        found = {k.removeprefix("step_"): v for k, v in values.items() if "step_" in k}
        assert found == said


@pytest.mark.parametrize(
    ("count", "faults", "warnings", "level", "message"),
    [
        (2, {}, [], Level.OK, "2 RSUs known"),
        (0, {}, [], Level.WARN, "no /rsu/info received yet"),
        (2, {}, ["nothing heard for 9 s"], Level.WARN, "2 RSUs known; nothing heard for 9 s"),
        (0, {"a": "bad"}, [], Level.ERROR, "0 RSUs known; RsuInfo of a refused: bad"),
        (3, {"a": "bad"}, [], Level.WARN, "3 RSUs known; RsuInfo of a refused: bad"),
    ],
)
def test_the_network(
    count: int, faults: dict[str, str], warnings: list[str], level: Level, message: str
) -> None:
    found = of_network(count, faults, warnings)
    assert (found.level, found.message) == (level, message)


def test_an_rsu_that_lies() -> None:
    liar, suspect = of_rsus(
        [REPORT, replace(REPORT, rsu_id="c", state=RsuState.SUSPECT)], {}, {}, {}
    )
    assert (liar.level, liar.message) == (Level.ERROR, REPORT.text)
    assert suspect.level is Level.WARN
    assert (liar.subject, liar.hardware_id) == ("rsu b", "b")
    assert liar.values == {
        "age_s": "0.2",
        "rate_hz": "10.0",
        "accept_ratio": "0.12",
        "measurements": "80",
        "innovation: azimuth": "0.351",
        "innovation / sd: azimuth": "12.00",
    }


def test_rsus_that_are_refused_or_strange() -> None:
    silent = replace(REPORT, rsu_id="e", state=RsuState.SUSPECT, text="silent for 30 s")
    found = of_rsus(
        [replace(REPORT, state=RsuState.OK, text="ok"), silent],
        {"a": ALL, "b": SOME, "c": ONCE},
        {"d": "its range bias sd must be finite"},
        {"e": Stranger(30.0, 3)},
    )
    assert [(f.hardware_id, f.level, f.message) for f in found] == [
        ("a", Level.ERROR, ALL.words()),
        ("b", Level.WARN, SOME.words()),
        ("c", Level.OK, "ok"),
        ("d", Level.ERROR, "RsuInfo refused: its range bias sd must be finite"),
        ("e", Level.ERROR, "clock 30.0 s ahead of three others"),
    ]
    assert found[0].values == {"refused: variance": "50"}


AS_STATED = RsuErrors(
    stamp_ns=1,
    rsu_id="a2",
    vue_id="v",
    quantities=("RANGE",),
    scatter=(1.1,),
    bias=(0.02,),
    bias_sd=(0.01,),
    bias_spread=(0.05,),
    correlation_time_s=(30.0,),
    stretch=(0.0,),
    stretch_sd=(0.0,),
)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, ""),
        (
            {"bias": (0.12,), "scatter": (3.1,)},
            "ranges 0.12 m long, scatter 3.1 times as stated",
        ),
        ({"bias": (-0.5,)}, "ranges 0.50 m short"),
        ({"scatter": (0.5,)}, "ranges scatter 0.5 times as stated"),
        ({"quantities": ("TDOA",), "bias": (0.3,)}, "time differences 0.30 m long"),
        ({"quantities": ("TOA",), "bias": (-0.3,)}, "toa 1.0 ns early"),
        (
            {"quantities": ("AZIMUTH",), "bias": (math.radians(2.0),)},
            "azimuth off by 2.0 deg",
        ),
        ({"quantities": ("COSINE_Y",), "bias": (-0.05,)}, "cosine_y off by -0.050"),
        (
            {"bias": (0.12,), "stretch": (0.0694,), "stretch_sd": (0.004,)},
            "ranges 6.9 % long, 0.12 m long",
        ),
        ({"stretch": (-0.02,), "stretch_sd": (0.001,)}, "ranges 2.0 % short"),
        ({"stretch": (0.02,), "stretch_sd": (0.007,)}, ""),
        ({"stretch": (0.0009,), "stretch_sd": (0.0001,)}, ""),
    ],
)
def test_words(change: dict[str, tuple[float, ...]], said: str) -> None:
    assert errors_in_words(replace(AS_STATED, **change)) == said


def test_several_quantities() -> None:
    both = replace(
        AS_STATED,
        quantities=("AZIMUTH", "RANGE"),
        scatter=(1.0, 2.0),
        bias=(0.1, 0.0),
        bias_sd=(0.01, 0.01),
        stretch=(0.0, 0.0),
        stretch_sd=(0.0, 0.0),
    )
    assert errors_in_words(both) == "azimuth off by 5.7 deg; ranges scatter 2.0 times as stated"


def test_diagnostics_say_it_and_call_it_no_fault() -> None:
    report = RsuReport(rsu_id="a2", state=RsuState.OK, text="ok")
    long = replace(AS_STATED, bias=(0.12,))
    (found,) = of_rsus([report], {}, {}, {}, {"a2": long, "not heard": long})
    assert (found.level, found.message) == (Level.OK, "ok; ranges 0.12 m long")
    assert found.values["learned bias: RANGE"] == "0.12 +- 0.01"
    assert found.values["learned scatter: RANGE"] == "1.10"
    assert "learned stretch: RANGE" not in found.values
    stretched = replace(AS_STATED, stretch=(0.0694,), stretch_sd=(0.004,))
    (of_network,) = of_rsus([report], {}, {}, {}, {"a2": stretched})
    assert of_network.values["learned stretch: RANGE"] == "0.0694 +- 0.004"
    (plain,) = of_rsus([report], {}, {}, {}, {"a2": AS_STATED})
    assert plain.message == "ok"
