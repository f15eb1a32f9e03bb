"""What the health of the RSUs is told of an epoch, and what it makes of it: figures and words."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from health_stream import observe
from netpos.estimation.measurement import GROUP, KIND, ROW_WIDTH, Kind
from netpos.messages.values import GroundSpeed, RsuMeasurement
from netpos.tracking.health.health import HealthConfig, RsuHealth
from netpos.tracking.health.observations import (
    FittedEpoch,
    Observation,
    mean_nis,
    medians,
    off,
    rate_hz,
    words,
)

S = 1_000_000_000


def measured(rsu_id: str, stamp_ns: int) -> RsuMeasurement:
    return RsuMeasurement(stamp_ns=stamp_ns, rsu_id=rsu_id, vue_id="v")


def epoch_of(stamp_ns: int, rng: np.random.Generator) -> FittedEpoch:
    """RSU a: azimuth and time, and a position fix; a speed; RSU b: a range."""
    kinds = [Kind.AZIMUTH, Kind.TOA, Kind.LINEAR, Kind.LINEAR, Kind.SPEED, Kind.RANGE]
    rows = np.zeros((6, ROW_WIDTH))
    rows[:, KIND], rows[:, GROUP] = kinds, [0, 0, 0, 0, 1, 2]
    fits = np.column_stack([rng.normal(size=6), rng.uniform(0.5, 2.0, size=6)])
    speed = GroundSpeed(stamp_ns=stamp_ns, vue_id="v", speed_mps=1.0, speed_var=1.0)
    items = (measured("a", stamp_ns), speed, measured("b", stamp_ns))
    return FittedEpoch(stamp_ns, "v", items, rows, fits, [1.0, 1.0, float(rng.random() < 0.5)])


def test_rows_find_their_measurement() -> None:
    epoch = epoch_of(7 * S, np.random.default_rng(1))
    (a, first), (b, second) = epoch.observations()
    assert (a, b) == ("a", "b")
    assert first == (7 * S, "v", True, ("AZIMUTH", "TOA"), tuple(epoch.innovations[:2].ravel()))
    taken = bool(epoch.accepted[2])
    assert second == (7 * S, "v", taken, ("RANGE",), tuple(epoch.innovations[5]))


@pytest.mark.parametrize("asked_every", [7, 1000])
def test_health_does_not_depend_on_when_it_is_asked(asked_every: int) -> None:
    """Epochs are taken in portions; asked after each it is the same, also where a track goes
    back."""
    rng = np.random.default_rng(2)
    epochs = [epoch_of(S + k * S // 10, rng) for k in range(150)]
    epochs[100:100] = epochs[95:100]  # gone back to, and heard again
    heard, asked = RsuHealth(), RsuHealth()
    for k, epoch in enumerate(epochs):
        if k == 100:
            heard.rewind("v", epoch.stamp_ns)
            asked.rewind("v", epoch.stamp_ns)
        heard.hear(epoch)
        asked.hear(epoch)
        reports = asked.reports(epoch.stamp_ns)
        if k % asked_every == 0:
            assert heard.reports(epoch.stamp_ns) == reports
    now_ns = epochs[-1].stamp_ns
    assert heard.reports(now_ns) == asked.reports(now_ns)
    assert heard.report("b", now_ns).measurements > 100


def test_all_are_used_until_one_is_isolated() -> None:
    """From then on what the isolated one measures is only looked at."""
    health = RsuHealth()
    for k in range(80):
        stamp_ns = S + k * S // 10
        items = [measured(rsu_id, stamp_ns) for rsu_id in "abc"]
        used, watched = health.sort_out(stamp_ns, items, lambda _: True)
        lies = health.excluded("b", stamp_ns)
        assert [m.rsu_id for m in watched] == ["b"] * lies
        assert [m.rsu_id for m in used] == (["a", "c"] if lies else ["a", "b", "c"])
        for rsu_id in "abc":
            error = 30.0 if rsu_id == "b" else 0.5
            observe(health, rsu_id, "v", stamp_ns, rsu_id != "b", {"range": (error, 1.0)})
    assert health.excluded("b", 10 * S)


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
        observe(health, "a", "v", k * 250_000_000, k % 2 == 0, {"range": (float(k % 5), 2.0)})
    report = health.report("a", 10_000_000_000)
    # Slots up to 7 s are judged at 9.75 s: measurements 20..27 are the last eight.
    assert report.measurements == 28
    assert report.accept_ratio == 0.5
    assert report.rate_hz == pytest.approx(4.0)
    assert report.mean_innovation == {"range": float(np.median([k % 5 for k in range(20, 28)]))}
    assert report.mean_normalised["range"] == report.mean_innovation["range"] / 2


@pytest.mark.parametrize("name", ["slot_s", "isolate_after_count", "window", "lapse_s"])
@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf])
def test_unsound_settings_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        HealthConfig(**{name: value})
