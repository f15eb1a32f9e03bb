"""Clocks against network time: that of a device, offset rho and drift alpha (fokin2020:eq.1,
fokin2020:eq.2),

alpha[n] = beta alpha[n-1] + eta[n],   rho[n] = rho[n-1] + alpha[n] T

and those of the RSUs, which a network keeps together to a few nanoseconds."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy.signal import lfilter

from netpos.radio.noise import generator, normals, stream_key

Array = npt.NDArray[np.float64]


@dataclass(
    frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
)
class ClockModel:
    """How a device clock starts and wanders; the defaults are those of fokin2020 section 2.4.

    ``drift_step_sd`` is the standard deviation of eta per step T, whatever T is (as in the paper).
    """

    offset_mean_s: float = 0.0
    offset_sd_s: float = Field(default=100e-6, ge=0)
    drift_mean: float = 25e-6
    drift_sd: float = Field(default=30e-6, ge=0)
    drift_step_sd: float = Field(default=6.3e-8, ge=0)
    beta: float = Field(default=1.0, gt=0, le=1)

    def densities(self, step_s: float) -> tuple[float, float]:
        """White [s/sqrt(s)] and random-walk [(s/s)/sqrt(s)] frequency noise of the continuous
        clock whose offsets at instants ``step_s`` apart have the law of this one's (beta 1).

        The second differences of the offsets here are eta T, white. Those of a continuous clock
        (w, q) have the variance 2 w^2 T + 2/3 q^2 T^3 and the covariance -w^2 T + q^2 T^3 / 6 with
        the next: white, too, where w^2 = q^2 T^2 / 6.

        Raises ``ValueError`` for a step that is no time, and where beta is not 1.
        """
        if self.beta != 1.0:
            raise ValueError(f"beta must be 1, got {self.beta}: no white and random-walk noise")
        if not 0.0 < step_s < math.inf:
            raise ValueError(f"step_s must be finite and > 0 s, got {step_s}")
        return (
            self.drift_step_sd * math.sqrt(step_s / 6.0),
            self.drift_step_sd / math.sqrt(step_s),
        )


def simulate_clock(
    model: ClockModel, stamps_ns: npt.NDArray[np.int64], seed: int, name: str
) -> tuple[Array, Array]:
    """Offset [s] and drift [s/s], both (n,), at equally spaced stamps; the first is rho[0],
    alpha[0]."""
    start = generator(seed, f"{name}/clock/start").standard_normal(2)
    offset_0 = model.offset_mean_s + model.offset_sd_s * start[0]
    drift_0 = model.drift_mean + model.drift_sd * start[1]
    eta = model.drift_step_sd * normals(stamps_ns, 1, stream_key(seed, f"{name}/clock"))[:, 0]
    eta[0] = drift_0
    drift = np.asarray(lfilter([1.0], [1.0, -model.beta], eta), dtype=np.float64)
    steps = drift * np.diff(stamps_ns, prepend=stamps_ns[:1]) * 1e-9
    return offset_0 + np.cumsum(steps), drift


@dataclass(
    frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
)
class NetworkClockModel:
    """How well the RSUs' clocks agree: errors of standard deviation ``sd_s`` each, with the
    autocorrelation ``exp(-t / correlation_time_s)`` of a disciplined clock.

    ``reference`` names the RSU whose clock *is* network time. ``declared`` says whether the RSUs
    describe these errors (``RsuInfo.range_bias_sd_m``), so that a tracker estimates them.
    """

    sd_s: float = Field(gt=0)
    correlation_time_s: float = Field(default=100.0, gt=0)
    reference: str | None = None
    declared: bool = True


CLOCK_TONES = 64


def clock_tones(model: NetworkClockModel, seed: int, rsu_id: str) -> Array:
    """(CLOCK_TONES, 3) amplitude [s], angular frequency [rad/s] and phase [rad] of an RSU's clock
    error under a seed; amplitude 0 at the reference.

    The sum of the tones is a stationary process known at any instant without its past. One
    frequency comes from each of the equally likely slices of the wanted spectrum, a Cauchy
    distribution of scale 1 / correlation time, so its mean autocorrelation is exactly the wanted
    one (spectral method, Shinozuka and Deodatis 1991).
    """
    rng = generator(seed, f"{rsu_id}/clock")
    slice_ = (np.arange(CLOCK_TONES) + rng.random(CLOCK_TONES)) / CLOCK_TONES
    frequency = np.tan(0.5 * math.pi * slice_) / model.correlation_time_s
    phase = 2.0 * math.pi * rng.random(CLOCK_TONES)
    sd_s = 0.0 if rsu_id == model.reference else model.sd_s
    amplitude = np.full(CLOCK_TONES, sd_s * math.sqrt(2.0 / CLOCK_TONES))
    return np.column_stack([amplitude, frequency, phase])


@njit(cache=True)
def clock_error(elapsed_s: float, tones: Array) -> float:
    """Clock minus network time [s] of an RSU at a time on any fixed scale; tones (k, 3)."""
    error = 0.0
    for k in range(tones.shape[0]):
        error += tones[k, 0] * math.cos(tones[k, 1] * elapsed_s + tones[k, 2])
    return error
