"""The RSUs a tracker knows, and how the slow errors of each enter the state of a track."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.common.pair_errors import of_each_receiver
from netpos.estimation.measurement import (
    BIAS,
    COMMON,
    GATE_VARIANCE,
    GROUP,
    REFERENCE,
    SAME_BEND_S,
    Kind,
)
from netpos.estimation.rows import WHITE, RowErrors, rsu_axes, rsu_place, scalar_kinds
from netpos.estimation.sensors.table import BY_KIND, SENSORS, readings
from netpos.estimation.state import N_CORE, VELOCITY
from netpos.estimation.unexplained import unexplained
from netpos.messages.values import (
    AngleConvention,
    Array,
    RsuErrors,
    RsuInfo,
    RsuMeasurement,
    StepCalibration,
)
from netpos.tracking.rest import rests
from netpos.tracking.rsus.error_model import ErrorModel
from netpos.tracking.rsus.learning import WINDOW_S, LearnedErrors, Name
from netpos.tracking.rsus.shift import CHANGE, DeviceState

_RSU = "rsu/"
_WHOSE = [BIAS, REFERENCE, COMMON, GROUP]
_OUTLIER_SD = 4.0  # of what values share, where it is one: one Gaussian error in 16,000
REFERENCED = sum(int(r.field) for s, r in readings() if s.difference_of >= 0)
"""Fields that compare the RSU with a second one."""
_RENEWED_S = 1e-6  # correlation time of what is new at every epoch
_SLOW = {name for s in SENSORS for name in (s.bias_sd, s.common_bias_sd) if name is not None}


def values_as_one(lasts_s: float, since_s: float) -> float:
    """Variance factor of a value ``since_s`` [s] after the one before it. Errors that last
    ``lasts_s`` [s] become white noise of the same spectral density at 0: the values of that time
    count as one. 1 for a first value (``since_s`` not above 0)."""
    return max(1.0, lasts_s / since_s) if since_s > 0.0 else 1.0


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

    def bias_sd(self, kind: Kind, reference: Rsu | None = None) -> float:
        """Standard deviation of the biases in rows of a kind, 0 where there are none: of the RSU's
        own, and in a difference that of the ``reference``, too (None: the RSU's own alone)."""
        name = BY_KIND[kind].bias_sd
        own = 0.0 if name is None else float(getattr(self.info, name))
        if reference is None or not is_difference(kind):
            return own
        return math.hypot(own, reference.bias_sd(kind))

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

    @property
    def has_no_back(self) -> bool:
        """Whether devices are taken to be in front of its array: neither a CONE array nor two
        antennas tell front from back."""
        return self.cone or self.info.baseline_m > 0.0

    def in_front(self, dx: float, dy: float) -> bool:
        """Whether a horizontal offset from the RSU is one its array can see."""
        if not self.has_no_back:
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


def is_difference(kind: Kind) -> bool:
    """Whether a row of a kind compares an RSU with a second one, the reference."""
    return BY_KIND[kind].difference_of >= 0


def _name(m: RsuMeasurement, kind: Kind) -> Name:
    """Whose errors those of a measurement's row of a kind are: of an RSU, or of a pair."""
    of_pair = f"{m.rsu_id}-{m.reference_rsu_id}"
    return _RSU + (of_pair if is_difference(kind) else m.rsu_id), kind.name


class _Biases(NamedTuple):
    """The states of the biases in a row: the RSU's own, and the one that is subtracted (0:
    none)."""

    own: int
    reference: int

    @property
    def states(self) -> tuple[int, ...]:
        """Those that there are."""
        return self[:2] if self.reference else self[:1]


class SlowErrors(NamedTuple):
    """The slow errors that rows name as states of a track.

    first : index of the state of the first of them
    sd (k,) : standard deviation of each; lasts (k,) : whether it is the same at the next epoch
    """

    first: int
    sd: Array
    lasts: npt.NDArray[np.bool_]


class PriorChange(NamedTuple):
    """The sd of the prior of a bias state is not what it was."""

    state: int
    before: float
    after: float


@dataclass(slots=True)
class BiasStates:
    """State entries for the slow sensor errors of one track, added when an RSU, or a source of
    step velocities, is first heard; the first has the index ``first``."""

    first: int = N_CORE
    steps: StepErrors = StepErrors()
    learned: LearnedErrors | None = None
    sd: list[float] = field(default_factory=list)
    tau_s: list[float] = field(default_factory=list)
    _slots: dict[Name, int] = field(default_factory=dict)
    _biases: dict[Name, _Biases] = field(default_factory=dict)
    """Of those learned."""
    _last_ns: dict[Name, int] = field(default_factory=dict)
    version: int = 0
    """Changes with ``sd`` and ``tau_s``."""

    def copy(self) -> BiasStates:
        """An independent copy; the lists and the slots are replaced, never changed."""
        last_ns = self._last_ns.copy()
        learned = None if self.learned is None else self.learned.copy()
        return BiasStates(
            self.first,
            self.steps,
            learned,
            self.sd,
            self.tau_s,
            self._slots,
            self._biases,
            last_ns,
            self.version,
        )

    def arrays(self) -> Array:
        """(2, k): standard deviation and time constant of each."""
        return np.array([self.sd, self.tau_s]).reshape(2, -1)

    @property
    def slow_errors(self) -> SlowErrors:
        """All of them, as a first fix takes them."""
        return SlowErrors(self.first, np.array(self.sd), np.array(self.tau_s) > _RENEWED_S)

    def row_errors(
        self,
        rsu: Rsu,
        m: RsuMeasurement,
        variance: Array,
        reference: Rsu | None = None,
        shares: bool = False,
    ) -> tuple[RowErrors, ...]:
        """Slow and coloured errors of the scalar rows of ``m``, of ``variance`` (rows,) as stated:
        as the RSU declares them or, where errors are learned, by what is learned of it; new biases
        are added to ``sd`` and ``tau_s``. Empty where all errors are white and unbiased.

        reference : the RSU from which a difference counts
        shares : another difference of this epoch counts from the same RSU
        """
        plain = rsu.plain and not shares and (reference is None or reference.plain)
        if plain and self.learned is None:
            return ()
        found = []
        for kind, stated in zip(rsu.kinds(m), variance.tolist(), strict=False):
            errors = self._of_row(rsu, m, kind, stated, reference)
            found.append(self._with_shared_noise(m, kind, errors) if shares else errors)
        return tuple(found)

    def _of_row(
        self, rsu: Rsu, m: RsuMeasurement, kind: Kind, stated: float, reference: Rsu | None
    ) -> RowErrors:
        scale, gate, tau_s = 1.0, 1.0, rsu.info.noise_correlation_time_s
        if self.learned is not None:
            if BY_KIND[kind].bias_sd is None:
                return WHITE
            name, tau_s = _name(m, kind), tau_s or WINDOW_S
            declared = rsu.bias_sd(kind, reference), rsu.info.bias_correlation_time_s
            model = self.learned.model(name, math.sqrt(stated), *declared, m.stamp_ns)
            scale, gate = model.scale, model.gate_scale
            own, other = self._learned_biases(name, m, kind, model)
        else:
            own = self._bias_slot(rsu, kind) if rsu.bias_sd(kind) > 0.0 else -1
            other = 0
            if reference is not None and is_difference(kind) and reference.bias_sd(kind) > 0.0:
                other = self._bias_slot(reference, kind)
        common = self._common_slot(rsu, kind) if rsu.common_bias_sd(kind) > 0.0 else -1
        inflation = scale * self._inflation(m, tau_s, kind)
        same_bend = self._inflation(m, SAME_BEND_S, kind) - 1.0 if own >= 0 else 0.0
        return RowErrors(own, common, other, inflation, gate, same_bend, self._stretch(kind)[0])

    def stretches(self, rsu: Rsu, m: RsuMeasurement) -> tuple[RowErrors, ...]:
        """Of the errors of the scalar rows of ``m`` only the share by which all distances are too
        long."""
        return tuple(WHITE._replace(stretch=self._stretch(kind)[0]) for kind in rsu.kinds(m))

    def _stretch(self, kind: Kind) -> tuple[float, float]:
        """By which share values of a kind are too long, and the sd of that; 0 of what is no
        distance."""
        if self.learned is None or not (self.learned.stretched and BY_KIND[kind].stretches):
            return 0.0, 0.0
        return self.learned.stretch.share, self.learned.stretch.sd

    def _bias_slot(self, rsu: Rsu, kind: Kind) -> int:
        """Index of an RSU's own bias as it declares it."""
        name = _RSU + rsu.info.rsu_id, kind.name
        return self._slot(name, rsu.bias_sd(kind), rsu.info.bias_correlation_time_s)

    def _with_shared_noise(self, m: RsuMeasurement, kind: Kind, own: RowErrors) -> RowErrors:
        """The errors with half of the variance of a difference in a state that those of one epoch
        with the same reference share, and that is new at every epoch."""
        reading = BY_KIND[kind].reading
        if reading is None or not is_difference(kind):
            return own
        sd = reading.scale * math.sqrt(getattr(m, reading.variance) / 2.0)
        name = ("reference/" + m.reference_rsu_id, kind.name)
        k = self._slot(name, sd, _RENEWED_S) - self.first
        if self.sd[k] != sd:
            self.sd = [*self.sd[:k], sd, *self.sd[k + 1 :]]
            self.version += 1
        half = 0.5 * own.inflation, 0.5 * own.gate
        return own._replace(common=self.first + k, inflation=half[0], gate=half[1])

    def _learned_biases(
        self, name: Name, m: RsuMeasurement, kind: Kind, model: ErrorModel
    ) -> _Biases:
        """The states of the biases of what is learned under ``name``. Those of the two RSUs of a
        difference are alike until other pairs tell them apart."""
        if name not in self._biases:
            two = is_difference(kind)
            sd, tau_s = model.bias_sd / math.sqrt(1.0 + two), model.time_s(0.0)
            own = self._slot((_RSU + m.rsu_id, kind.name), sd, tau_s)
            other = self._slot((_RSU + m.reference_rsu_id, kind.name), sd, tau_s) if two else 0
            self._biases = {**self._biases, name: _Biases(own, other)}
        return self._biases[name]

    def learn(
        self, rows: Array, accepted: Array, posterior: DeviceState
    ) -> tuple[list[Name], list[PriorChange]]:
        """Learn from what the ``posterior`` leaves of ``rows`` (m, ROW_WIDTH), of which groups
        were ``accepted`` (groups,). Differences to an RSU that heard the device late are accepted
        with what they share, and say nothing of their own errors. Returns what was concluded of
        whom, and the bias states whose sd changed."""
        learned = self.learned
        if learned is None:
            return [], []
        stamp_ns, mean, cov, height_m, _ = posterior
        velocity = mean[VELOCITY].tolist()
        still = rests(velocity, cov.diagonal()[VELOCITY].tolist())
        learned.move(stamp_ns, mean[CHANGE], still)
        whose = rows[:, _WHOSE].astype(np.int64).tolist()
        of_biases: dict[tuple[int, ...], Name] = {b: name for name, b in self._biases.items()}
        named = [
            (i, of_biases[own, reference])
            for i, (own, reference, common, group) in enumerate(whose)
            if (own, reference) in of_biases
            and accepted[group]
            and not self._is_outlier(common, mean)
        ]
        if named:
            taken, names = [i for i, _ in named], [name for _, name in named]
            gate = np.array([learned.models[name].gate_scale for name in names])
            left = unexplained(mean, cov, rows, height_m)[taken]
            learned.hear(names, rows[taken], left, rows[taken, GATE_VARIANCE] / gate)
        speed = 0.0 if still else math.hypot(*velocity)
        concluded = learned.conclude(posterior)
        return concluded, self._take_learned(learned, concluded, speed)

    def _is_outlier(self, common: int, mean: Array) -> bool:
        """Whether the noise ``common`` (-1: none) that values of one epoch share is an outlier in
        ``mean`` (n,). A bias that lasts is none."""
        k = common - self.first
        if k < 0 or self.tau_s[k] > _RENEWED_S:
            return False
        return bool(abs(mean[common]) > _OUTLIER_SD * self.sd[k])

    def _take_learned(
        self, learned: LearnedErrors, concluded: Collection[Name], speed_mps: float
    ) -> list[PriorChange]:
        """Give each bias state the sd and time learned of it; the states whose sd changed."""
        said = of_each_receiver(
            (self._biases[name].states, model.bias_sd**2, model.time_s(speed_mps))
            for name, model in learned.models.items()
        )
        changed = {state for name in concluded for state in self._biases[name].states}
        self.sd, self.tau_s = self.sd.copy(), self.tau_s.copy()
        changes = []
        for state, (variance, time_s) in said.items():
            k = state - self.first
            self.tau_s[k] = time_s
            if state in changed:
                changes.append(PriorChange(state, self.sd[k], math.sqrt(variance)))
                self.sd[k] = math.sqrt(variance)
        return changes

    def errors(
        self, names: Iterable[Name], mean: Array, cov: Array, stamp_ns: int, vue_id: str
    ) -> tuple[RsuErrors, ...]:
        """What is learned under ``names``, by RSU; the biases are states of ``mean`` (n,) with
        ``cov`` (n, n)."""
        if self.learned is None:
            return ()
        quantities: dict[str, list[str]] = {}
        for rsu_id, quantity in sorted(names):
            quantities.setdefault(rsu_id, []).append(quantity)
        found = []
        for rsu_id, of_it in quantities.items():
            models = [self.learned.models[rsu_id, quantity] for quantity in of_it]
            biases = [self._bias_of((rsu_id, quantity), mean, cov) for quantity in of_it]
            stretches = [self._stretch(Kind[quantity]) for quantity in of_it]
            found.append(
                RsuErrors(
                    stamp_ns=stamp_ns,
                    rsu_id=rsu_id.removeprefix(_RSU),
                    vue_id=vue_id,
                    quantities=tuple(of_it),
                    scatter=tuple(math.sqrt(model.gate_scale) for model in models),
                    bias=tuple(bias for bias, _ in biases),
                    bias_sd=tuple(sd for _, sd in biases),
                    bias_spread=tuple(model.bias_sd for model in models),
                    correlation_time_s=tuple(model.time_s(0.0) for model in models),
                    stretch=tuple(stretch for stretch, _ in stretches),
                    stretch_sd=tuple(sd for _, sd in stretches),
                )
            )
        return tuple(found)

    def _bias_of(self, name: Name, mean: Array, cov: Array) -> tuple[float, float]:
        """The bias of what is learned under ``name``, or the difference of two, and its sd."""
        own, other = self._biases[name]
        h = np.zeros(mean.size)
        h[own] = 1.0
        if other:
            h[other] = -1.0
        return float(h @ mean), math.sqrt(float(h @ cov @ h))

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
        if rsu.plain and self.learned is None:
            return
        for kind in rsu.kinds(m):
            self._last_ns[_name(m, kind)] = m.stamp_ns

    def _slot(self, name: Name, sd: float, tau_s: float) -> int:
        if name not in self._slots:
            self._slots = {**self._slots, name: self.first + len(self.sd)}
            self.sd = [*self.sd, sd]
            self.tau_s = [*self.tau_s, tau_s]
            self.version += 1
        return self._slots[name]

    def _common_slot(self, rsu: Rsu, kind: Kind) -> int:
        """Index of the bias that the network of an RSU shares."""
        name = ("network/" + rsu.info.network, str(BY_KIND[kind].common_bias_sd))
        tau_s = rsu.info.common_bias_correlation_time_s
        return self._slot(name, rsu.common_bias_sd(kind), tau_s)

    def _inflation(self, m: RsuMeasurement, tau_s: float, kind: Kind) -> float:
        """``values_as_one`` of ``m`` and the value before it that was fused."""
        since_ns = m.stamp_ns - self._last_ns.get(_name(m, kind), m.stamp_ns)
        return values_as_one(tau_s, since_ns * 1e-9)
