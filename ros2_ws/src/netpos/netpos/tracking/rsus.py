"""The RSUs a tracker knows, and how the slow errors of each enter the state of a track."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from netpos.filters.measurement import Kind
from netpos.filters.rows import UNCOUPLED, Coupling, rsu_axes, rsu_place, scalar_kinds
from netpos.filters.sensors.table import BY_KIND, SENSORS
from netpos.filters.state import N_CORE
from netpos.messages.values import (
    AngleConvention,
    Array,
    RsuInfo,
    RsuMeasurement,
    StepCalibration,
)

_SLOW = {name for s in SENSORS for name in (s.bias_sd, s.common_bias_sd) if name is not None}


@dataclass(frozen=True, slots=True)
class Rsu:
    """A known RSU: its description and the rotation map -> RSU axes (9,)."""

    info: RsuInfo
    axes: Array
    place: Array
    """What its rows hold of it, of ``rsu_place``."""
    cone: bool
    """Its angles are those of linear arrays."""
    plain: bool
    """Its errors are white and unbiased."""

    @classmethod
    def of(cls, info: RsuInfo) -> Rsu:
        """Rsu of its description."""
        slow = [getattr(info, name) for name in (*_SLOW, "noise_correlation_time_s")]
        axes = rsu_axes(info)
        cone = info.angle_convention is AngleConvention.CONE
        return cls(info, axes, rsu_place(info, axes), cone, not any(slow))

    def bias_sd(self, kind: Kind) -> float:
        """Standard deviation of the RSU's own bias in rows of a kind; 0 where it has none."""
        name = BY_KIND[kind].bias_sd
        return 0.0 if name is None else float(getattr(self.info, name))

    def common_bias_sd(self, kind: Kind) -> float:
        """Standard deviation of the bias that its network shares in rows of a kind; 0: none."""
        name = BY_KIND[kind].common_bias_sd
        return 0.0 if name is None else float(getattr(self.info, name))

    def kinds(self, m: RsuMeasurement) -> tuple[Kind, ...]:
        """Kinds of the scalar rows a measurement of this RSU gives."""
        return scalar_kinds(int(m.fields), self.info.angle_convention)

    def phase_fault(self) -> str | None:
        """Reason to refuse a phase difference of this RSU."""
        return None if self.info.baseline_m > 0.0 else "no_baseline"

    def in_front(self, dx: float, dy: float) -> bool:
        """Whether a horizontal offset from the RSU is one its array can see: neither a CONE array
        nor two antennas tell front from back."""
        if not self.cone and not self.info.baseline_m:
            return True
        return bool(self.axes[0] * dx + self.axes[1] * dy >= 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepErrors:
    """What is wrong with all steps of a person alike: sd of the logarithm of true over reported
    length, and of the angle from reported to true heading [rad]; 0: nothing. ``tau_s``:
    correlation time of both."""

    length_sd: float = 0.0
    heading_sd_rad: float = 0.0
    tau_s: float = 0.0


@dataclass(slots=True)
class BiasStates:
    """State entries for the slow sensor errors of one track, added when an RSU, or a source of
    step velocities, is first heard; the first has the index ``first``."""

    first: int = N_CORE
    steps: StepErrors = StepErrors()
    sd: list[float] = field(default_factory=list)
    tau_s: list[float] = field(default_factory=list)
    _slots: dict[tuple[str, str], int] = field(default_factory=dict)
    _last_ns: dict[tuple[str, Kind], int] = field(default_factory=dict)

    def copy(self) -> BiasStates:
        """An independent copy; the lists and the slots are replaced, never changed."""
        last_ns = self._last_ns.copy()
        return BiasStates(self.first, self.steps, self.sd, self.tau_s, self._slots, last_ns)

    def arrays(self) -> Array:
        """(2, k): standard deviation and time constant of each."""
        return np.array([self.sd, self.tau_s]).reshape(2, -1)

    def coupling(self, rsu: Rsu, m: RsuMeasurement) -> Coupling:
        """Coupling of the rows of ``m``; new biases are added to ``sd`` and ``tau_s``."""
        if rsu.plain:
            return UNCOUPLED
        info = rsu.info
        bias: dict[Kind, int] = {}
        common: dict[Kind, int] = {}
        inflation: dict[Kind, float] = {}
        for kind in rsu.kinds(m):
            if rsu.bias_sd(kind) > 0.0:
                name = ("rsu/" + info.rsu_id, kind.name)
                bias[kind] = self._slot(name, rsu.bias_sd(kind), info.bias_correlation_time_s)
            if rsu.common_bias_sd(kind) > 0.0:
                name = ("network/" + info.network, str(BY_KIND[kind].common_bias_sd))
                tau = info.common_bias_correlation_time_s
                common[kind] = self._slot(name, rsu.common_bias_sd(kind), tau)
            if info.noise_correlation_time_s > 0.0:
                inflation[kind] = self._inflation(info, kind, m.stamp_ns)
        return Coupling(bias, common, inflation)

    def of_steps(self, source: str) -> tuple[int, int]:
        """State indices of the length factor and the heading offset of a source of step
        velocities, -1 for what is not estimated; new ones are appended."""
        length, heading = self.steps.length_sd, self.steps.heading_sd_rad
        return (
            self._slot((source, "length"), length, self.steps.tau_s) if length > 0.0 else -1,
            self._slot((source, "heading"), heading, self.steps.tau_s) if heading > 0.0 else -1,
        )

    def step_calibration(self, mean: Array, cov: Array) -> StepCalibration:
        """What a state (n,) with covariance (n, n) says of the first source of step velocities
        heard."""
        factor, factor_sd, offset, offset_sd = 1.0, 0.0, 0.0, 0.0
        places = {name: i for (_, name), i in reversed(self._slots.items()) if i < mean.size}
        if "length" in places:
            i = places["length"]
            factor = math.exp(mean[i])
            factor_sd = factor * math.sqrt(cov[i, i])
        if "heading" in places:
            i = places["heading"]
            offset, offset_sd = float(mean[i]), math.sqrt(cov[i, i])
        return StepCalibration(
            length_factor=factor,
            length_factor_sd=factor_sd,
            heading_offset_rad=offset,
            heading_offset_sd_rad=offset_sd,
        )

    def accepted(self, rsu: Rsu, m: RsuMeasurement) -> None:
        """Note that ``m`` was fused: correlated noise is counted from here."""
        if rsu.plain:
            return
        for kind in rsu.kinds(m):
            self._last_ns[rsu.info.rsu_id, kind] = m.stamp_ns

    def _slot(self, name: tuple[str, str], sd: float, tau_s: float) -> int:
        if name not in self._slots:
            self._slots = {**self._slots, name: self.first + len(self.sd)}
            self.sd = [*self.sd, sd]
            self.tau_s = [*self.tau_s, tau_s]
        return self._slots[name]

    def _inflation(self, info: RsuInfo, kind: Kind, stamp_ns: int) -> float:
        """White noise of the same spectral density at 0: variance times correlation time over
        sampling interval."""
        last = self._last_ns.get((info.rsu_id, kind))
        if last is None or stamp_ns <= last:
            return 1.0
        return max(1.0, info.noise_correlation_time_s * 1e9 / (stamp_ns - last))
