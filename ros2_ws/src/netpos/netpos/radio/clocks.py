"""The device clock against network time: offset rho and drift alpha (fokin2020:eq.1,
fokin2020:eq.2).

alpha[n] = beta alpha[n-1] + eta[n],   rho[n] = rho[n-1] + alpha[n] T
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
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
