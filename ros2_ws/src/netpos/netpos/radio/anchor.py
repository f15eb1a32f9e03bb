"""The two-antenna anchor: its array, and double-sided two-way ranging (petukhov:fig.1, 2).

Two antennas on the anchor's y axis, a baseline L apart, share one oscillator. The master, at
y = -L/2 (the paper's +L/2: its x axis points to the right of the boresight), ranges; both receive
the last message, and the phase difference of what they receive is

    phase = 2 pi (L / lambda) sin(theta),  sin(theta) = -y / |d|                   (petukhov:eq.5)

wrapped to [-pi, pi). The array cannot tell front from back: it serves its front half-plane.
"""

from __future__ import annotations

import math
from typing import Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from netpos.radio.propagation import SPEED_OF_LIGHT_MPS

UWB_CHANNELS_MHZ = {
    0: 499.2,
    1: 3494.4,
    2: 3993.6,
    3: 4492.8,
    4: 3993.6,
    5: 6489.6,
    6: 6988.8,
    7: 6489.6,
    8: 7488.0,
    9: 7987.2,
    10: 8486.4,
    11: 7987.2,
    12: 8985.6,
    13: 9484.8,
    14: 9984.0,
    15: 9484.8,
}
"""Centre frequencies of the HRP UWB channels, IEEE 802.15.4-2020 table 15-2 (4, 7, 11 and 15 are
wide)."""

HALF_VIEW_RAD = math.pi / 2


def uwb_wavelength_m(channel: int) -> float:
    """Wavelength at the centre of a UWB channel. Raises ``ValueError`` for an unknown number."""
    if channel not in UWB_CHANNELS_MHZ:
        raise ValueError(f"uwb_channel must be one of 0 to 15, got {channel}")
    return SPEED_OF_LIGHT_MPS / (UWB_CHANNELS_MHZ[channel] * 1e6)


@dataclass(
    frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
)
class TwoAntennas:
    """Baseline and wavelength of an anchor."""

    uwb_channel: int = Field(default=5, ge=0, le=15)
    baseline_wavelengths: float = Field(ge=0.5, le=10.0)

    @property
    def wavelength_m(self) -> float:
        """At the centre of the channel."""
        return uwb_wavelength_m(self.uwb_channel)

    @property
    def baseline_m(self) -> float:
        """Distance of the two antennas."""
        return self.baseline_wavelengths * self.wavelength_m


@dataclass(
    frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
)
class TwoWayRanging:
    """Double-sided two-way ranging: the device polls, the anchor responds after
    ``anchor_reply_s``, the device ends the exchange ``device_reply_s`` later (petukhov:fig.2).

    ``timestamp_sd_s``: of each of the three receptions; transmissions are scheduled.
    ``drift_sd``: of each of the two clocks' rates (s/s), drawn once per anchor and device.
    ``asymmetric``: (Tr1 Tr2 - D1 D2) / (Tr1 + Tr2 + D1 + D2) of round trips Tr and replies D,
    whose drift leaves a scale error alone (Neirynck, Luk and McLaughlin 2016, eq. 9).
    ``symmetric``: (Tr1 - D1 + Tr2 - D2) / 4, which needs equal replies: their difference times
    the relative drift stays in the distance.
    """

    timestamp_sd_s: float = Field(default=160e-12, gt=0)
    anchor_reply_s: float = Field(default=1e-3, gt=0)
    device_reply_s: float = Field(default=1e-3, gt=0)
    drift_sd: float = Field(default=5e-6, ge=0, le=1e-3)
    method: Literal["asymmetric", "symmetric"] = "asymmetric"

    @property
    def range_sd_m(self) -> float:
        """Standard deviation of the distance that follows from the timestamps."""
        poll, final = 0.25, 0.25  # the response counts 0.5: it is in both round trips
        if self.method == "asymmetric":
            replies_s = 2.0 * (self.anchor_reply_s + self.device_reply_s)
            poll, final = self.device_reply_s / replies_s, self.anchor_reply_s / replies_s
        gain = math.hypot(poll, 0.5, final)
        return SPEED_OF_LIGHT_MPS * self.timestamp_sd_s * gain

    def residual(self, device_drift: float, anchor_drift: float) -> tuple[float, float]:
        """Error that the clock rates (s/s) leave in the distance: scale [1] and offset [m]."""
        scale = (device_drift + anchor_drift) / 2.0
        if self.method == "asymmetric":
            return scale, 0.0
        relative, longer_s = device_drift - anchor_drift, self.anchor_reply_s - self.device_reply_s
        return scale, SPEED_OF_LIGHT_MPS * relative * longer_s / 4.0
