"""Step detector against synthetic gait with known contacts."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from netpos.inertial.steps import (
    CELL_S,
    CellAverager,
    Step,
    StepConfig,
    StepDetector,
    amplitude_response,
    band_pass_kernel,
)
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

G = 9.80665
START_S = 3.0


def gait(
    rate_hz: float, cadence_hz: float, steps: int, amplitude: float, noise: float = 0.1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rest, walk, rest -> stamps (n,), force (n, 3), peak times (k,).

    The amplitude rises and falls over one step: 75 % at the first and the last peak.
    """
    walk_s = steps / cadence_hz
    t = np.arange(0.0, START_S + walk_s + 4.0, 1.0 / rate_hz)
    phase = 2 * np.pi * cadence_hz * (t - START_S)
    inside = (t >= START_S) & (t < START_S + walk_s)
    edge = np.minimum(t - START_S, START_S + walk_s - t) * cadence_hz  # in steps
    ramp = np.clip(edge + 0.25, 0.0, 1.0)
    vertical = -amplitude * ramp * np.cos(phase)
    rng = np.random.default_rng(3)
    force = np.column_stack(
        [0.2 * vertical * inside, 0.5 * np.sin(phase / 2) * inside, G + vertical]
    ) + rng.normal(scale=noise, size=(t.size, 3))
    peaks = START_S + (np.arange(steps) + 0.5) / cadence_hz
    return np.rint(t * 1e9).astype(np.int64), force, peaks


def detect(stamps: np.ndarray, force: np.ndarray, config: StepConfig | None = None) -> list[Step]:
    d, out = StepDetector(config), []
    for s, f in zip(stamps.tolist(), force.tolist(), strict=True):
        out += d.add(s, (f[0], f[1], f[2]))
    return out


def ends(steps: list[Step]) -> np.ndarray:
    return np.array([s.end_ns for s in steps]) * 1e-9


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 200.0, 285.714])
@pytest.mark.parametrize(("cadence_hz", "amplitude"), [(0.9, 1.0), (1.8, 3.0), (2.8, 8.0)])
def test_every_step_is_found_at_its_time(
    rate_hz: float, cadence_hz: float, amplitude: float
) -> None:
    stamps, force, peaks = gait(rate_hz, cadence_hz, 30, amplitude)
    detected_s = ends(detect(stamps, force)) - StepConfig().contact_lag_s
    rebound = detected_s > peaks[-1] + 0.5 / cadence_hz  # of the filter, after a slow walk
    assert np.count_nonzero(rebound) <= (1 if cadence_hz < 1.0 else 0)
    detected_s = detected_s[~rebound]
    assert detected_s.size == peaks.size
    np.testing.assert_allclose(detected_s, peaks, atol=0.1)
    assert abs(np.median(detected_s - peaks)) < 0.04  # lead of the gravity high-pass at 0.9 Hz


def test_cadence_and_interval_chain() -> None:
    steps = detect(*gait(100.0, 1.6, 20, 2.5, noise=0.02)[:2])
    for a, b in itertools.pairwise(steps):
        assert b.start_ns == a.end_ns
    assert np.median([s.cadence_hz for s in steps]) == pytest.approx(1.6, abs=0.05)


def test_detection_does_not_depend_on_the_device_orientation() -> None:
    stamps, force, _ = gait(100.0, 1.8, 25, 2.5)
    rng = np.random.default_rng(5)
    reference = detect(stamps, force)
    for _ in range(5):
        turned = Rotation.random(rng=rng).apply(force)
        steps = detect(stamps, turned)
        assert [s.end_ns for s in steps] == [s.end_ns for s in reference]
        np.testing.assert_allclose(
            [s.bounce_mps2 for s in steps], [s.bounce_mps2 for s in reference], rtol=1e-9
        )


def test_delay_within_a_bout_is_bounded() -> None:
    stamps, force, _ = gait(100.0, 1.8, 25, 2.5)
    d, config, worst, n = StepDetector(), StepConfig(), 0.0, 0
    for s, f in zip(stamps.tolist(), force.tolist(), strict=True):
        for step in d.add(s, (f[0], f[1], f[2])):
            n += 1
            if n > config.bout_steps:  # the opening ones wait for the third
                worst = max(worst, s * 1e-9 - (step.end_ns * 1e-9 - config.contact_lag_s))
    assert 0.0 < worst <= config.delay_s


@pytest.mark.parametrize(("steps", "detected"), [(2, 0), (3, 3)])
def test_a_bout_opens_at_three_steps(steps: int, detected: int) -> None:
    assert len(detect(*gait(100.0, 1.8, steps, 3.0, noise=0.02)[:2])) == detected


@pytest.mark.parametrize(("amplitude", "expected"), [(0.05, 0), (0.6, 20)])
def test_prominence_floor(amplitude: float, expected: int) -> None:
    assert len(detect(*gait(100.0, 1.8, 20, amplitude, noise=0.02)[:2])) == expected


@pytest.mark.parametrize(("turn_radps", "steps"), [(0.5, 0), (0.0, 13)])
def test_turning_the_device_in_the_hand_is_not_walking(turn_radps: float, steps: int) -> None:
    """The same 1.5 Hz shaking counts at a fixed tilt and not while the device turns over."""
    t = np.arange(0.0, 16.0, 0.01)
    shaking = (t > 4.0) & (t < 13.0)
    vertical = G + np.where(shaking, 0.7 * np.sin(2 * np.pi * 1.5 * (t - 4.0)), 0.0)
    tilt = np.clip(t - 3.0, 0.0, None) * turn_radps
    force = np.column_stack([vertical * np.sin(tilt), 0 * t, vertical * np.cos(tilt)])
    detected = detect(np.rint(t * 1e9).astype(np.int64), force)
    assert len(detected) == pytest.approx(steps, abs=1 if steps else 0)


def test_rest_has_no_steps_and_is_still() -> None:
    rng = np.random.default_rng(2)
    force = np.array([0.0, 0.0, G]) + rng.normal(scale=0.03, size=(2000, 3))
    d = StepDetector()
    assert not d.still  # the window is not full yet
    steps = [s for i, f in enumerate(force.tolist()) for s in d.add(i * 10**7, tuple(f))]
    assert steps == []
    assert d.still


@pytest.mark.parametrize(("sd", "still"), [(0.14, True), (0.16, False)])
def test_still_threshold_at_its_boundary(sd: float, still: bool) -> None:
    """A square wave of height +-sd, slower than the cells, has exactly that sd."""
    d = StepDetector(StepConfig(still_acceleration_sd_mps2=0.15))
    for i in range(500):  # two halves of the 1 s window
        d.add(i * 10**7, (sd if (i // 50) % 2 else -sd, 0.0, G))
    assert d.acceleration_sd_mps2 == pytest.approx(sd, rel=0.02)
    assert d.still is still


@pytest.mark.parametrize("rate_hz", [37.0, 50.0, 100.0, 285.714])
def test_cell_mean_of_a_ramp_is_its_value_at_the_centre(rate_hz: float) -> None:
    cells, out = CellAverager(), []
    for i in range(200):
        s = round(i / rate_hz * 1e9)
        out += cells.add(s, (3.0 * s * 1e-9, 1.0, -s * 1e-9))
    centres = np.array([c for c, _ in out]) * 1e-9
    means = np.array([m for _, m in out])
    np.testing.assert_allclose(means[:, 0], 3.0 * centres, atol=1e-9)
    np.testing.assert_allclose(means[:, 1], 1.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(centres), CELL_S, atol=1e-9)


def test_band_pass_is_zero_phase_and_stops_gravity_and_impacts() -> None:
    """Gain by the Fourier sum at 0, 1.8 and 12 Hz."""
    k = band_pass_kernel(0.08, 0.4, 0.5)
    np.testing.assert_allclose(k, k[::-1], atol=1e-15)
    t = (np.arange(k.size) - k.size // 2) * CELL_S
    gain = [abs(np.sum(k * np.exp(-2j * np.pi * f * t))) for f in (0.0, 1.8, 12.0)]
    assert gain[0] < 1e-12
    assert 0.55 < gain[1] < 1.2
    assert gain[2] < 0.02


@pytest.mark.parametrize("cadence_hz", [1.2, 1.8, 2.3])
@pytest.mark.parametrize("config", [StepConfig(), StepConfig.waist()])
def test_bounce_is_the_range_of_the_vertical_whatever_the_band(
    cadence_hz: float, config: StepConfig
) -> None:
    """A sine of amplitude A has range 2 A, before the band-pass attenuates it."""
    amplitude = 2.0
    stamps, force, peaks = gait(100.0, cadence_hz, 40, amplitude, noise=0.0)
    if config.signal == "impact":
        force = with_impacts(stamps, force, peaks, (8.0, 2.0, 0.0))
    steps = detect(stamps, force, config)
    middle = [s.bounce_mps2 for s in steps[10:30]]
    assert np.median(middle) == pytest.approx(2 * amplitude, rel=0.1)


def with_impacts(
    stamps: np.ndarray,
    force: np.ndarray,
    contacts: np.ndarray,
    jolt: tuple[float, float, float] = (-2.0, 0.5, 3.0),
) -> np.ndarray:
    """A decaying 12 Hz oscillation after every contact."""
    tau = (stamps * 1e-9)[:, None] - contacts
    decay = np.where(tau > 0, np.exp(-np.clip(tau, 0.0, None) / 0.05), 0.0)
    burst = (decay * np.sin(2 * np.pi * 12 * tau)).sum(axis=1)
    return force + np.outer(burst, jolt)


def test_impacts_are_found_without_any_bounce() -> None:
    """Slow, uneven contacts that only jolt; the same stream has no step for a carried device."""
    rng = np.random.default_rng(8)
    contacts = 4.0 + np.cumsum(rng.uniform(0.5, 1.6, 25))
    t = np.arange(0.0, contacts[-1] + 4.0, 0.01)
    stamps = np.rint(t * 1e9).astype(np.int64)
    still = np.array([0.0, 0.0, G]) + rng.normal(scale=0.05, size=(t.size, 3))
    force = with_impacts(stamps, still, contacts)
    detected_s = ends(detect(stamps, force, StepConfig.waist()))
    late = np.abs(detected_s[:, None] - contacts).min(axis=0)
    assert detected_s.size == contacts.size
    assert late.max() < 0.07
    for r in Rotation.random(3, rng=rng):
        turned = ends(detect(stamps, r.apply(force), StepConfig.waist()))
        np.testing.assert_allclose(turned, detected_s, atol=1e-9)
    assert len(detect(stamps, force)) < 10


@pytest.mark.parametrize(("jolt", "expected"), [(0.3, 0), (1.0, 20)])
def test_impact_floor(jolt: float, expected: int) -> None:
    """Jerk of about 3 * 2 pi 12 * jolt m/s^3 before smoothing, against a floor of 8."""
    t = np.arange(0.0, 24.0, 0.01)
    stamps = np.rint(t * 1e9).astype(np.int64)
    still = np.tile([0.0, 0.0, G], (t.size, 1))
    force = still + jolt * 0.3 * (with_impacts(stamps, still, 4.0 + 0.7 * np.arange(20)) - still)
    assert len(detect(stamps, force, StepConfig.waist())) == expected


@pytest.mark.parametrize(("hz", "expected"), [(4.0, 0), (6.5, 20)])
def test_only_sharp_jolts_are_contacts(hz: float, expected: int) -> None:
    """Bursts of one frequency with the same jerk, below and above ``min_impact_hz`` of 5 Hz."""
    contacts = 4.0 + 0.8 * np.arange(20)
    t = np.arange(0.0, 22.0, 0.01)
    tau = t[:, None] - contacts
    burst = (np.exp(-((tau / 0.12) ** 2)) * np.sin(2 * np.pi * hz * tau)).sum(axis=1)
    force = np.column_stack([0 * t, 0 * t, G + 12.0 / hz * burst])
    stamps = np.rint(t * 1e9).astype(np.int64)
    assert len(detect(stamps, force, StepConfig.waist())) == expected


def test_a_step_after_a_stand_takes_a_typical_period() -> None:
    """Contacts 0.6 s apart, a stand of 1.8 s in between, shorter than a bout's longest gap."""
    contacts = np.concatenate([4.0 + 0.6 * np.arange(10), 11.2 + 0.6 * np.arange(10)])
    t = np.arange(0.0, 20.0, 0.01)
    stamps = np.rint(t * 1e9).astype(np.int64)
    force = with_impacts(stamps, np.tile([0.0, 0.0, G], (t.size, 1)), contacts)
    steps = detect(stamps, force, StepConfig.waist())
    assert len(steps) == 20
    durations = [s.duration_s for s in steps]
    np.testing.assert_allclose(durations, 0.6, atol=0.07)
    assert steps[10].start_ns > steps[9].end_ns
    assert steps[11].start_ns == steps[10].end_ns


def test_impact_delay_within_a_bout_is_bounded() -> None:
    config = StepConfig.waist()
    contacts = 4.0 + 0.6 * np.arange(20)
    t = np.arange(0.0, 20.0, 0.01)
    stamps = np.rint(t * 1e9).astype(np.int64)
    force = with_impacts(stamps, np.tile([0.0, 0.0, G], (t.size, 1)), contacts)
    d, delays = StepDetector(config), []
    for s, f in zip(stamps.tolist(), force.tolist(), strict=True):
        delays += [(s - step.end_ns) * 1e-9 for step in d.add(s, tuple(f))]
    assert len(delays) == 20
    assert max(delays[config.bout_steps :]) <= config.delay_s - config.contact_lag_s + 0.02


@pytest.mark.parametrize("frequency_hz", [0.0, 1.0, 2.2, 6.0])
def test_amplitude_response_is_the_fourier_sum(frequency_hz: float) -> None:
    k = band_pass_kernel(0.05, 0.3, 0.5)
    t = np.arange(1000) * CELL_S
    out = np.convolve(np.cos(2 * np.pi * frequency_hz * t), k, "valid")
    gain = amplitude_response(k, frequency_hz)
    wave = np.cos(2 * np.pi * frequency_hz * t)[k.size // 2 : -(k.size // 2)]
    np.testing.assert_allclose(out, gain * wave, atol=1e-9)


def test_reset_forgets_an_open_bout() -> None:
    stamps, force, _ = gait(100.0, 1.8, 20, 3.0)
    d = StepDetector()
    cut = int((START_S + 5.0) * 100)
    for s, f in zip(stamps[:cut].tolist(), force[:cut].tolist(), strict=True):
        d.add(s, tuple(f))
    d.reset()
    assert not d.still
    assert math.isinf(d.acceleration_sd_mps2)


@pytest.mark.parametrize(
    "bad",
    [
        {"min_prominence": 0.0},
        {"prominence_fraction": 1.0},
        {"trend_sd_s": 0.05},
        {"max_interval_s": 0.2},
        {"contact_lag_s": math.nan},
        {"filter_half_width_s": 0.1},
        {"bout_steps": 0},
        {"signal": "smell"},
    ],
)
def test_bad_config_names_the_value(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        StepConfig(**bad)


def streamed(t: np.ndarray, vertical: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,) and force (n, 3) of a vertical acceleration (n,) over gravity at times (n,)."""
    force = np.column_stack([np.zeros((t.size, 2)), G + vertical])
    return np.rint(t * 1e9).astype(np.int64), force


def test_impacts_are_dated_without_a_lag() -> None:
    """Jumps of the force at any phase of the 20 ms cells: found half a sample before the first
    sample after the jump, on the average; half a cell is 10 ms."""
    jumps = 4.0 + np.cumsum(np.random.default_rng(2).uniform(0.55, 0.75, 60))
    t = np.arange(0.0, jumps[-1] + 3.0, 0.01)
    after = np.searchsorted(t, jumps)
    config = StepConfig.waist()
    steps = detect(*streamed(t, 2.0 * (np.searchsorted(jumps, t) % 2)), config)
    detected_s = ends(steps) - config.contact_lag_s
    assert detected_s.size == jumps.size
    late = detected_s - (t[after] - 0.005)
    assert np.abs(late).max() <= 0.5 * CELL_S
    assert abs(late.mean()) < 0.003


@pytest.mark.parametrize(("share", "expected"), [(0.95, 9), (1.05, 8)])
def test_a_rebound_is_no_step(share: float, expected: int) -> None:
    """Eight steps, then a dip and the low rise after it: counted only where its height is at least
    ``min_height_fraction`` of its prominence, both taken from the band-passed signal."""
    cadence_hz = 1.8
    t = np.arange(0.0, 12.0, CELL_S)
    last = START_S + 7.5 / cadence_hz
    edge = np.minimum(t - START_S, START_S + 8 / cadence_hz - t) * cadence_hz
    walk = np.clip(edge + 0.25, 0.0, 1.0) * np.cos(2 * np.pi * cadence_hz * (t - START_S))
    vertical = -3.0 * walk - 4.0 * np.exp(-0.5 * ((t - last - 0.4) / 0.12) ** 2)
    gravity = lfilter([CELL_S], [1.0, CELL_S - 1.0], vertical)  # its change, low-passed with 1 s
    band = np.convolve(vertical - gravity, band_pass_kernel(0.08, 0.4, 0.5), "same")
    valley = band[(t > last) & (t < last + 0.6)].min()
    height = band[(t > last + 0.5) & (t < last + 1.3)].max()
    config = StepConfig(min_height_fraction=share * height / (height - valley))
    assert len(detect(*streamed(t, vertical), config)) == expected


def test_a_bounce_is_the_rise_from_the_valley_to_the_step() -> None:
    """A limp: the vertical rises from -3 to 3 and from -1 to 1 m/s^2 in turn. Counted with the
    fall from the peak before, or from the deeper valley before, the small ones would be 4. The
    band-pass takes a part of what alternates."""
    cadence_hz, turning = 1.8, np.tile([-3.0, 3.0, -1.0, 1.0], 14)
    in_halves = np.arange(0.0, 14 * 4 - 1, 0.01 * 2 * cadence_hz)
    which = in_halves.astype(int)
    share = 0.5 * (1.0 - np.cos(np.pi * (in_halves - which)))
    vertical = turning[which] * (1.0 - share) + turning[which + 1] * share
    t = np.arange(vertical.size) * 0.01
    middle = detect(*streamed(t, vertical))[6:20]
    peak_at = (np.array([s.end_ns for s in middle]) * 1e-9 + 0.05) * 2 * cadence_hz
    expected = np.where(np.round(peak_at).astype(int) % 4 == 1, 6.0, 2.0)
    bounce = np.array([s.bounce_mps2 for s in middle])
    assert set(expected) == {2.0, 6.0}
    np.testing.assert_allclose(bounce, expected, atol=0.9)
