"""The OFDM beacon: its energy at the RSU, and the Cramér-Rao bound of the time of arrival."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from netpos.radio.propagation import PathLoss, path_loss_db

Array = npt.NDArray[np.float64]

BOLTZMANN_JPK = 1.380649e-23


@dataclass(
    frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
)
class Waveform:
    """Pilot subcarriers of a beacon, evenly spaced and equally strong, and the receiver that hears
    them.

    Defaults, from public 5G NR figures: carrier 3.5 GHz (band n78); subcarriers 30 kHz apart
    (numerology 1); a sparse comb of 20 pilots, 16 subcarriers (480 kHz) apart, which spans 9.1
    MHz; one symbol per beacon. Transmit power -40 dBm is the minimum output power of an NR device
    (3GPP TS 38.101-1 section 6.3.1): an always-on positioning beacon towards RSUs tens of metres
    away needs no more, and spares the battery and the neighbours' pilots. Receiver noise figure 5
    dB (Report ITU-R M.2412-0, base station) at 290 K."""

    carrier_hz: float = Field(default=3.5e9, gt=0)
    subcarrier_spacing_hz: float = Field(default=30e3, gt=0)
    pilots: int = Field(default=20, ge=2)
    pilot_stride: int = Field(default=16, ge=1)
    symbols: int = Field(default=1, ge=1)
    tx_power_dbm: float = -40.0
    noise_figure_db: float = Field(default=5.0, ge=0)
    temperature_k: float = Field(default=290.0, gt=0)

    @property
    def rms_bandwidth_hz(self) -> float:
        """Root mean square of the pilot frequencies about their mean."""
        k = np.arange(self.pilots) - (self.pilots - 1) / 2
        return float(self.subcarrier_spacing_hz * self.pilot_stride * np.sqrt(np.mean(k**2)))

    @property
    def energy_snr_at_0_db_loss(self) -> float:
        """Energy of the whole beacon (without cyclic prefixes) over the noise density, one
        element, no path loss (linear)."""
        energy = 1e-3 * 10 ** (self.tx_power_dbm / 10) * self.symbols / self.subcarrier_spacing_hz
        density = BOLTZMANN_JPK * self.temperature_k * 10 ** (self.noise_figure_db / 10)
        return energy / density


def received_snr(
    waveform: Waveform, path_loss: PathLoss, elements: int, distance_m: float
) -> float:
    """Signal-to-noise energy ratio summed over elements, pilots and symbols at a distance [m]
    (linear)."""
    loss = path_loss_db(distance_m, path_loss.coefficients(waveform.carrier_hz))
    return float(elements * waveform.energy_snr_at_0_db_loss * 10 ** (-loss / 10))


def delay_bound(waveform: Waveform, snr: float) -> float:
    """Cramér-Rao bound of the delay [s^2] for one path of unknown amplitude and phase.

    ``1 / (2 snr (2 pi B)^2)`` with B the rms bandwidth; ``snr`` as in ``received_snr``.
    """
    if not snr > 0:
        raise ValueError(f"snr must be > 0 (linear), got {snr}")
    return float(1 / (2 * snr * (2 * math.pi * waveform.rms_bandwidth_hz) ** 2))
