"""What is learned of an RSU, in words and in /diagnostics."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from netpos.messages.values import RsuErrors
from netpos.tracking.diagnosis import Level, of_rsus
from netpos.tracking.error_words import words
from netpos.tracking.health import RsuReport, RsuState

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
    ],
)
def test_words(change: dict[str, tuple[float, ...]], said: str) -> None:
    assert words(replace(AS_STATED, **change)) == said


def test_several_quantities() -> None:
    both = replace(
        AS_STATED,
        quantities=("AZIMUTH", "RANGE"),
        scatter=(1.0, 2.0),
        bias=(0.1, 0.0),
        bias_sd=(0.01, 0.01),
    )
    assert words(both) == "azimuth off by 5.7 deg; ranges scatter 2.0 times as stated"


def test_diagnostics_say_it_and_call_it_no_fault() -> None:
    report = RsuReport(rsu_id="a2", state=RsuState.OK, text="ok")
    long = replace(AS_STATED, bias=(0.12,))
    (found,) = of_rsus([report], {}, {}, {}, {"a2": long, "not heard": long})
    assert (found.level, found.message) == (Level.OK, "ok; ranges 0.12 m long")
    assert found.values["learned bias: RANGE"] == "0.12 +- 0.01"
    assert found.values["learned scatter: RANGE"] == "1.10"
    (plain,) = of_rsus([report], {}, {}, {}, {"a2": AS_STATED})
    assert plain.message == "ok"
