"""Cramér-Rao bounds against a numerical Fisher information with nuisance parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.radio.arrays import AntennaArray, direction_bound
from netpos.radio.propagation import PathLoss
from netpos.radio.waveform import Waveform, delay_bound, received_snr

PLANAR = AntennaArray(kind="planar")
CYLINDER = AntennaArray(kind="cylindrical", rows=4, columns=16)


def _signal(theta: np.ndarray, array: AntennaArray, waveform: Waveform) -> np.ndarray:
    """Noise-free samples on (element, pilot) of one path; the delay is scaled by 1e9."""
    azimuth, elevation, delay_ns, amplitude, phase = theta
    towards = np.array(
        [
            math.cos(azimuth) * math.cos(elevation),
            math.sin(azimuth) * math.cos(elevation),
            math.sin(elevation),
        ]
    )
    places = array.elements + np.array([3.0, -2.0, 1.0])  # any origin: the phase takes it up
    tones = waveform.subcarrier_spacing_hz * waveform.pilot_stride * np.arange(waveform.pilots)
    angle = (places @ towards)[:, None] - tones * delay_ns * 1e-9
    return (amplitude * np.exp(1j * (2 * math.pi * angle + phase))).ravel()


def _numerical_bound(
    array: AntennaArray,
    waveform: Waveform,
    snr: float,
    az: float,
    el: float,
    *,
    known_elevation: bool,
) -> np.ndarray:
    """Inverse Fisher information of all five (or four) parameters, by central differences."""
    theta = np.array([az, el, 40.0, 1.0, 0.3])
    noise_var = array.count * waveform.pilots / snr
    step = 1e-6
    free = [0, 2, 3, 4] if known_elevation else [0, 1, 2, 3, 4]
    slopes = []
    for i in free:
        shift = np.zeros(5)
        shift[i] = step
        slopes.append(
            (_signal(theta + shift, array, waveform) - _signal(theta - shift, array, waveform))
            / (2 * step)
        )
    d = np.array(slopes)
    return np.linalg.inv(2 / noise_var * np.real(d.conj() @ d.T))


@pytest.mark.parametrize("array", [PLANAR, CYLINDER])
@pytest.mark.parametrize("azimuth_deg", [0.0, 35.0, -70.0, 160.0])
def test_bounds_are_the_inverse_fisher_information(
    array: AntennaArray, azimuth_deg: float
) -> None:
    waveform, snr, az = Waveform(), 200.0, math.radians(azimuth_deg)
    numerical = _numerical_bound(array, waveform, snr, az, 0.0, known_elevation=True)
    assert direction_bound(array, snr, az)[0, 0] == pytest.approx(numerical[0, 0], rel=1e-6)
    assert delay_bound(waveform, snr) == pytest.approx(numerical[1, 1] * 1e-18, rel=1e-6)
    both = _numerical_bound(array, waveform, snr, az, 0.3, known_elevation=False)
    np.testing.assert_allclose(
        direction_bound(array, snr, az, 0.3), both[:2, :2], rtol=1e-5, atol=1e-9
    )


def test_a_linear_row_gives_the_textbook_bound() -> None:
    """ULA of M half-wavelength elements: var(azimuth) = 6 / (pi^2 snr (M^2 - 1) cos^2), snr over
    all elements."""
    row = AntennaArray(kind="planar", rows=1, columns=8)
    az, snr = 0.4, 50.0
    expected = 6 / (math.pi**2 * snr * 63 * math.cos(az) ** 2)
    assert direction_bound(row, snr, az)[0, 0] == pytest.approx(expected)


def test_cylinder_is_isotropic_and_the_plane_is_not() -> None:
    bounds = [direction_bound(CYLINDER, 100.0, a)[0, 0] for a in np.linspace(-3, 3, 13)]
    np.testing.assert_allclose(bounds, bounds[0])
    ratio = (
        direction_bound(PLANAR, 100.0, math.pi / 3)[0, 0] / direction_bound(PLANAR, 100.0, 0)[0, 0]
    )
    assert ratio == pytest.approx(4.0)


def test_8_by_8_array_gives_2_degrees_at_minus_9_db_per_element() -> None:
    """fokin2020 section 3.1: 64 elements, 2 degrees. Broadside, one snapshot at -8.9 dB per
    element."""
    per_element = 10 ** (-8.9 / 10)
    sd_deg = math.degrees(math.sqrt(direction_bound(PLANAR, 64 * per_element, 0.0)[0, 0]))
    assert sd_deg == pytest.approx(2.0, abs=0.2)


def test_received_energy_by_hand() -> None:
    """-40 dBm over 1/30 kHz at 30 m in UMi: -40 - 74.3 - 44.8 dB(mWs) against -174 + 5 dBm/Hz."""
    loss = 32.4 + 21 * math.log10(30) + 20 * math.log10(3.5)
    density = 10 * math.log10(1.380649e-23 * 290 * 1e3) + 5
    expected_db = -40 - loss - 10 * math.log10(30e3) - density + 10 * math.log10(64)
    snr = received_snr(Waveform(), PathLoss(), 64, 30.0)
    assert 10 * math.log10(snr) == pytest.approx(expected_db)


@pytest.mark.parametrize(
    "bad",
    [{"columns": 1}, {"spacing_wavelengths": 0.6}, {"field_of_view_deg": 180.0}, {"gain": 1}],
)
def test_bad_array_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        AntennaArray(**bad)  # type: ignore[arg-type]
