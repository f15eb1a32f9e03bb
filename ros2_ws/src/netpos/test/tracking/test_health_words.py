"""The words and figures for what is wrong with an RSU, and what its health refuses to take."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from netpos.estimation.measurement import Kind
from netpos.tracking.health import HealthConfig, RsuHealth
from netpos.tracking.health_words import mean_nis, medians, off, rate_hz, words
from netpos.tracking.observations import Observation


def observed(
    kind: str, errors: Any, sd: float = 1.0, vues: tuple[str, ...] = ("v",), accepted: bool = False
) -> list[Observation]:
    """One observation per error, 0.1 s apart."""
    return [
        Observation(k * 100_000_000, vues[k % len(vues)], accepted, (kind,), (float(e), sd))
        for k, e in enumerate(errors)
    ]


@pytest.mark.parametrize(
    ("kind", "error", "vues", "text"),
    [
        ("azimuth", math.radians(20.1), ("v",), "azimuth off by 20.1 deg"),
        (Kind.AZIMUTH.name, math.radians(20.1), ("v",), "azimuth off by 20.1 deg"),
        (Kind.RANGE.name, 30.2, ("v",), "range late by 30.2 m"),
        ("elevation", math.radians(-20.1), ("v",), "elevation off by -20.1 deg"),
        ("phase", math.radians(20.1), ("v",), "phase off by 20.1 deg"),
        ("range", 30.2, ("v",), "range late by 30.2 m"),
        ("range", -30.2, ("v",), "range early by 30.2 m"),
        ("toa", 31.478, ("v",), "clock step of 105 ns or blocked path"),
        ("toa", 31.478, ("v", "w"), "clock step of 105 ns"),
        ("toa", -31.478, ("v",), "clock step of -105 ns"),
        ("cosine_y", 0.342, ("v",), "cosine_y off by 0.342"),
    ],
)
def test_what_a_kind_is_called(kind: str, error: float, vues: tuple[str, ...], text: str) -> None:
    errors = error + 1e-6 * np.arange(-5, 6)
    assert words(observed(kind, errors, 1e-3, vues)) == text


def test_worst_first() -> None:
    """An array turned and late at once; the kind that is fine is not named."""
    kinds, values = ("toa", "azimuth", "elevation"), (5.0, 1.0, 0.5, 0.01, 0.001, 0.01)
    entries = [Observation(k, "v", False, kinds, values) for k in range(9)]
    assert words(entries) == "azimuth off by 28.6 deg, clock step of 17 ns or blocked path"


def test_an_array_turned_round() -> None:
    """Innovations of +-180 deg do not cancel."""
    rng = np.random.default_rng(4)
    errors = (rng.normal(math.pi, 0.02, size=101) + math.pi) % math.tau - math.pi
    assert (errors > 0).any()
    assert (errors < 0).any()
    centre = medians(observed("azimuth", errors))["azimuth"]
    assert abs(centre) == pytest.approx(math.pi, abs=0.01)
    (phrase,) = off(observed("azimuth", errors, 0.02), 3.0)
    assert abs(float(phrase.split()[3])) == pytest.approx(180.0, abs=0.5)


def test_scatter_is_named() -> None:
    rng = np.random.default_rng(5)
    errors = rng.normal(0, 25.0, size=200)
    text = words(observed("range", errors, 0.5))
    assert text.startswith("range scatters ")
    assert float(text.split()[2]) == pytest.approx(50.0, rel=0.2)


def test_what_has_no_words() -> None:
    assert words(observed("range", [0.1, -0.2, 0.0])) == "refused by the gate"
    assert words([]) == "refused by the gate"


def test_the_limit_of_a_bias_at_its_boundary() -> None:
    assert off(observed("range", [1.499] * 5), 1.5) == []
    assert off(observed("range", [1.5] * 5), 1.5) == ["range late by 1.5 m"]


def test_figures() -> None:
    entries = observed("range", [1.0, -2.0, 6.0], 2.0)
    assert medians(entries) == {"range": 1.0}
    assert medians(entries, normalised=True) == {"range": 0.5}
    assert mean_nis(entries) == pytest.approx((1 + 4 + 36) / 4 / 3)
    assert mean_nis([]) == 0.0
    assert rate_hz(entries) == pytest.approx(10.0)
    assert rate_hz(entries[:1]) == rate_hz([]) == 0.0


def test_the_rate_is_that_of_the_last_ten_seconds() -> None:
    """A pause before them does not count, several devices at one stamp do."""
    old = observed("range", [0.0] * 50)
    new = [
        Observation(60_000_000_000 + k * 200_000_000, vue, True, (), ())
        for k in range(50)
        for vue in ("v", "w")
    ]
    assert rate_hz(old + new) == pytest.approx(10.0)


def test_figures_of_a_window_are_exact() -> None:
    health = RsuHealth(HealthConfig(window=8))
    for k in range(40):
        health.observe("a", "v", k * 250_000_000, k % 2 == 0, {"range": (float(k % 5), 2.0)})
    report = health.report("a", 10_000_000_000)
    # Slots up to 7 s are judged at 9.75 s: measurements 20..27 are the last eight.
    assert report.measurements == 28
    assert report.accept_ratio == 0.5
    assert report.rate_hz == pytest.approx(4.0)
    assert report.mean_innovation == {"range": float(np.median([k % 5 for k in range(20, 28)]))}
    assert report.mean_normalised["range"] == report.mean_innovation["range"] / 2


@pytest.mark.parametrize(
    "pair", [(math.nan, 1.0), (math.inf, 1.0), (0.0, 0.0), (0.0, -1.0), (0.0, math.nan)]
)
def test_unsound_innovations_are_refused(pair: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="rsu_7"):
        RsuHealth().observe("rsu_7", "v", 1, True, {"toa": pair})


@pytest.mark.parametrize("name", ["slot_s", "isolate_after_count", "window", "lapse_s"])
@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf])
def test_unsound_settings_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        HealthConfig(**{name: value})
