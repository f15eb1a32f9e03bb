"""Pedestrian dead reckoning: IMU samples in, steps and the mean velocity of the last step out.

Petukhov et al. (``petukhov``): the velocity of a step of length L, duration T and heading psi
(eq. 6, here with psi counter-clockwise from east) and its propagated covariance (eqs. 7-8,
completed by the off-diagonal term they leave out):

    v = (L / T) (cos psi, sin psi)                                              (petukhov:6)
    J = [[cos psi / T, -|v| sin psi], [sin psi / T, |v| cos psi]]
    C = J diag(sd_L^2, sd_psi^2) J^T                                            (petukhov:7-8)

Without a step the pseudo-measurement is zero velocity; it is stated tightly only when the
accelerometer and gyro are quiet. In between (start of a walk, handling, a single step) the
velocity is unknown: zero with ``undecided_speed_sd_mps`` and ``moving`` True.

Time is the stamp of the samples; there is no clock. Bad data never raises: it is counted in
``PedestrianDeadReckoning.counters`` under its reason.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from netpos.inertial.attitude import AttitudeConfig, AttitudeFilter, HeadingReference, wrap_angle
from netpos.inertial.steps import Step, StepConfig, StepDetector, weinberg_length

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float]
VectorLike = npt.NDArray[np.floating] | Sequence[float]

_POSITIVE = (
    "output_rate_hz",
    "weinberg_k",
    "length_sd_fraction",
    "heading_sd_rad",
    "still_speed_sd_mps",
    "undecided_speed_sd_mps",
    "still_rate_radps",
    "max_gap_s",
    "min_rate_hz",
    "max_rate_hz",
    "accelerometer_range_mps2",
    "gyro_range_radps",
    "clock_reset_s",
)
_NOT_NEGATIVE = ("heading_drift_radps", "gap_rate_sd_radps", "speed_drift_mps2")


@dataclass(frozen=True, slots=True, kw_only=True)
class PdrConfig:
    """All parameters of the core; a bad value raises ``ValueError`` here.

    weinberg_k : m (m/s^2)^(-1/4); 0.44 is the one scale fitted to a surveyed 122.9 m walk
        with a hand-held phone; calibrate per person over a known distance
    length_sd_fraction : sd of a step length over the length; k varies that much between people
    heading_sd_rad : heading sd at alignment, or with a magnetometer in use
    heading_drift_radps : growth of the heading sd without an accepted magnetic sample
    mount_heading_rad : walking direction minus the body x axis, counter-clockwise
    speed_drift_mps2 : growth of the velocity sd with the age of the last step
    gap_rate_sd_radps : how fast the device may turn unseen, for the heading sd after a gap
    clock_reset_s : a stamp this far in the past restarts the core instead of being refused
    """

    output_rate_hz: float = 10.0
    weinberg_k: float = 0.44
    length_sd_fraction: float = 0.2
    heading_sd_rad: float = 0.1
    heading_drift_radps: float = 0.001
    mount_heading_rad: float = 0.0
    still_speed_sd_mps: float = 0.05
    undecided_speed_sd_mps: float = 1.0
    still_rate_radps: float = 0.2
    speed_drift_mps2: float = 0.2
    max_gap_s: float = 0.25
    gap_rate_sd_radps: float = 0.5
    min_rate_hz: float = 25.0
    max_rate_hz: float = 2000.0
    accelerometer_range_mps2: float = 156.0
    gyro_range_radps: float = 34.8
    clock_reset_s: float = 1.0
    attitude: AttitudeConfig = field(default_factory=AttitudeConfig)
    steps: StepConfig = field(default_factory=StepConfig)

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"pdr.{name} must be finite and > 0, got {value}")
        for name in _NOT_NEGATIVE:
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"pdr.{name} must be finite and >= 0, got {value}; use 0 for off")
        if not abs(self.mount_heading_rad) <= math.pi:
            raise ValueError(
                f"pdr.mount_heading_rad must be in [-pi, pi] rad, got {self.mount_heading_rad}; "
                "is it in degrees?"
            )
        if self.max_rate_hz <= self.min_rate_hz:
            raise ValueError(
                f"pdr.max_rate_hz ({self.max_rate_hz}) must exceed min_rate_hz "
                f"({self.min_rate_hz}); raise it"
            )
        if self.max_gap_s * self.min_rate_hz <= 1:
            raise ValueError(
                f"pdr.max_gap_s ({self.max_gap_s}) must exceed 1 / min_rate_hz "
                f"({1 / self.min_rate_hz:.3g} s), or every sample is a gap; raise it"
            )


@dataclass(frozen=True, slots=True)
class StepEvent:
    """A step between the initial contacts ``start_ns`` and ``end_ns``.

    stamp_ns : the IMU sample that revealed it; the steps that open a bout share one
    count : 1 for the first step since construction
    heading_rad : walking direction, counter-clockwise from map x, [-pi, pi)
    heading_reference : "map" (x is east) or "relative" (x is the first body heading)
    """

    stamp_ns: int
    start_ns: int
    end_ns: int
    count: int
    length_m: float
    heading_rad: float
    heading_sd_rad: float
    length_sd_m: float
    cadence_hz: float
    heading_reference: HeadingReference


@dataclass(frozen=True, slots=True, eq=False)
class StepVelocity:
    """Horizontal velocity at ``stamp_ns``, the stamp of the IMU sample that produced it.

    velocity : (2,) m/s along map x, y: east and north when ``heading_reference`` is "map"
    covariance : (2, 2) m^2/s^2, symmetric positive definite
    moving : False only for the tight zero of stillness; True with zero velocity and a wide
        covariance while the state is undecided
    """

    stamp_ns: int
    velocity: Array
    covariance: Array
    moving: bool
    heading_reference: HeadingReference


@dataclass(frozen=True, slots=True)
class PdrOutput:
    """What one IMU sample produced: the steps it revealed and, at a tick, the velocity."""

    steps: tuple[StepEvent, ...]
    velocity: StepVelocity | None


def step_velocity(
    length_m: float,
    duration_s: float,
    heading_rad: float,
    length_sd_m: float,
    heading_sd_rad: float,
) -> tuple[Array, Array]:
    """Mean velocity of a step and its covariance (petukhov:6-8).

    Returns
    -------
    velocity (2,) m/s, covariance (2, 2) m^2/s^2; the duration counts as exact

    Raises
    ------
    ValueError  the duration is not positive
    """
    if not duration_s > 0:
        raise ValueError(f"step duration must be > 0 s, got {duration_s}")
    speed, c, s = length_m / duration_s, math.cos(heading_rad), math.sin(heading_rad)
    jacobian = np.array([[c / duration_s, -speed * s], [s / duration_s, speed * c]])
    cov = jacobian @ np.diag([length_sd_m**2, heading_sd_rad**2]) @ jacobian.T
    return np.array([speed * c, speed * s]), (cov + cov.T) / 2


def _vector(value: VectorLike) -> Vector | str:
    """Three finite floats, or the reason why not."""
    try:
        x, y, z = (float(v) for v in value)
    except (TypeError, ValueError):
        return "malformed"
    return (x, y, z) if math.isfinite(x + y + z) else "not_finite"


class PedestrianDeadReckoning:
    """Streaming core; see the module docstring for the model.

    ``counters`` keys: ``malformed``, ``not_finite``, ``stamp_duplicate``, ``stamp_backwards``,
    ``accelerometer_saturated``, ``gyro_saturated`` (sample refused); ``gap``, ``clock_reset``
    (restart); ``rate_out_of_range`` (per second of stream); ``gravity_implausible`` (an
    alignment window without 1 g: wrong unit?); ``magnetic_*`` (field sample not used).
    """

    def __init__(self, config: PdrConfig | None = None) -> None:
        self.config = config if config is not None else PdrConfig()
        self._count = 0
        self._counters: Counter[str] = Counter()
        self._attitude = AttitudeFilter(self.config.attitude)
        self._detector = StepDetector(self.config.steps)
        self._restart()

    @property
    def counters(self) -> dict[str, int]:
        return dict(self._counters)

    @property
    def attitude(self) -> AttitudeFilter:
        """The attitude filter, for reading only."""
        return self._attitude

    def _restart(self) -> None:
        """Forget everything but counters and the step count."""
        self._attitude.reset()
        self._last_ns: int | None = None
        self._next_tick_ns: int | None = None
        self._heading_fix_ns = 0
        self._gap_sd_rad = 0.0
        self._last_field_ns: int | None = None
        self._restart_detector()

    def _restart_detector(self) -> None:
        self._detector.reset()
        self._step: StepEvent | None = None
        self._forward: deque[tuple[int, float, float]] = deque()
        self._turn_rate = math.inf
        self._rate_start_ns: int | None = None
        self._rate_n = 0
        self._rate_ok = True

    def add_imu(
        self, stamp_ns: int, angular_velocity: VectorLike, specific_force: VectorLike
    ) -> PdrOutput | None:
        """Add one IMU sample in the body frame (FLU).

        Parameters
        ----------
        stamp_ns : later than the stamp of the last accepted sample
        angular_velocity : (3,) rad/s
        specific_force : (3,) m/s^2, about (0, 0, +9.81) at rest and level

        Returns
        -------
        PdrOutput with at least one step or a velocity, else None; None until aligned
        """
        rate, force = _vector(angular_velocity), _vector(specific_force)
        if isinstance(rate, str) or isinstance(force, str):
            self._counters[rate if isinstance(rate, str) else str(force)] += 1
            return None
        reason = self._sample_fault(stamp_ns, rate, force)
        if reason is not None:
            self._counters[reason] += 1
            return None
        dt_s = (stamp_ns - self._last_ns) * 1e-9 if self._last_ns is not None else 0.0
        if dt_s > self.config.max_gap_s:
            self._on_gap(dt_s)
        self._last_ns = stamp_ns
        self._watch_rate(stamp_ns)
        if not self._update_attitude(stamp_ns, dt_s, rate, force):
            return None
        steps = [self._event(stamp_ns, s) for s in self._detector.add(stamp_ns, force)]
        if steps:
            self._step = steps[-1]
        velocity = self._velocity(stamp_ns) if self._tick(stamp_ns) else None
        return PdrOutput(tuple(steps), velocity) if steps or velocity is not None else None

    def add_magnetic_field(self, stamp_ns: int, field_tesla: VectorLike) -> None:
        """Add one calibrated magnetometer sample (3,) in tesla, body frame.

        A sample without 1-1000 microtesla (wrong unit), out of order or more than
        ``max_gap_s`` from the IMU stream is counted and not used.
        """
        value = _vector(field_tesla)
        if isinstance(value, str):
            self._counters[f"magnetic_{value}"] += 1
            return
        if not 1e-6 < math.sqrt(sum(v * v for v in value)) < 1e-3:
            self._counters["magnetic_out_of_range"] += 1
            return
        if self._last_field_ns is not None and stamp_ns <= self._last_field_ns:
            self._counters["magnetic_stamp_backwards"] += 1
            return
        if self._last_ns is None or abs(stamp_ns - self._last_ns) > self.config.max_gap_s * 1e9:
            self._counters["magnetic_far_from_imu"] += 1
            return
        self._last_field_ns = stamp_ns
        was_relative = self._attitude.reference == "relative"
        result = self._attitude.add_magnetic_field(stamp_ns, value)
        if result != "used":
            self._counters[f"magnetic_{result}"] += 1
            return
        self._heading_fix_ns, self._gap_sd_rad = stamp_ns, 0.0
        if was_relative:  # the frame has just turned to east/north
            self._forward.clear()
            self._step = None

    def _sample_fault(self, stamp_ns: int, rate: Vector, force: Vector) -> str | None:
        last = self._last_ns
        if last is not None and stamp_ns <= last:
            if (last - stamp_ns) * 1e-9 < self.config.clock_reset_s:
                return "stamp_duplicate" if stamp_ns == last else "stamp_backwards"
            self._counters["clock_reset"] += 1
            self._restart()
        if max(map(abs, force)) >= self.config.accelerometer_range_mps2:
            return "accelerometer_saturated"
        if max(map(abs, rate)) >= self.config.gyro_range_radps:
            return "gyro_saturated"
        return None

    def _on_gap(self, dt_s: float) -> None:
        self._counters["gap"] += 1
        unseen = self.config.gap_rate_sd_radps * dt_s
        self._gap_sd_rad = min(math.hypot(self._gap_sd_rad, unseen), math.pi)
        self._attitude.reset(keep_heading=True)
        self._restart_detector()

    def _watch_rate(self, stamp_ns: int) -> None:
        if self._rate_start_ns is None:
            self._rate_start_ns = stamp_ns
            return
        self._rate_n += 1
        span_s = (stamp_ns - self._rate_start_ns) * 1e-9
        if span_s < 1.0:
            return
        rate_hz = self._rate_n / span_s
        self._rate_ok = self.config.min_rate_hz <= rate_hz <= self.config.max_rate_hz
        if not self._rate_ok:
            self._counters["rate_out_of_range"] += 1
        self._rate_start_ns, self._rate_n = stamp_ns, 0

    def _update_attitude(self, stamp_ns: int, dt_s: float, rate: Vector, force: Vector) -> bool:
        was_aligned = self._attitude.aligned
        if not self._attitude.add_imu(stamp_ns, rate, force):
            if self._attitude.alignment_failed:
                self._counters["gravity_implausible"] += 1
            self._detector.add(stamp_ns, force)
            return False
        if not was_aligned and self._heading_fix_ns == 0:
            self._heading_fix_ns = stamp_ns
        bias = self._attitude.bias_radps
        norm = math.sqrt(sum((r - b) ** 2 for r, b in zip(rate, bias, strict=True)))
        a = min(dt_s / 0.5, 1.0) if self._turn_rate < math.inf else 1.0
        self._turn_rate = norm if a == 1.0 else self._turn_rate + a * (norm - self._turn_rate)
        if not self._forward or stamp_ns - self._forward[-1][0] >= 18_000_000:
            x, y = self._attitude.forward
            self._forward.append((stamp_ns, x, y))
            horizon_ns = round(5e9 * self.config.steps.max_interval_s)
            while self._forward[0][0] < stamp_ns - horizon_ns:
                self._forward.popleft()
        return True

    def _event(self, stamp_ns: int, step: Step) -> StepEvent:
        x, y = self._attitude.forward
        inside = [f for f in self._forward if step.start_ns <= f[0] <= step.end_ns]
        if inside:
            x = sum(f[1] for f in inside) / len(inside)
            y = sum(f[2] for f in inside) / len(inside)
        horizontal = math.hypot(x, y)
        heading = math.atan2(y, x) + self.config.mount_heading_rad
        length = weinberg_length(step.prominence_mps2, self.config.weinberg_k)
        self._count += 1
        return StepEvent(
            stamp_ns=stamp_ns,
            start_ns=step.start_ns,
            end_ns=step.end_ns,
            count=self._count,
            length_m=length,
            heading_rad=wrap_angle(heading),
            heading_sd_rad=self._heading_sd(stamp_ns, horizontal),
            length_sd_m=self.config.length_sd_fraction * length,
            cadence_hz=step.cadence_hz,
            heading_reference=self._attitude.reference,
        )

    def _heading_sd(self, stamp_ns: int, horizontal: float) -> float:
        """Heading sd; a nearly vertical forward axis (small ``horizontal``) spoils it."""
        drift = self.config.heading_drift_radps * max(stamp_ns - self._heading_fix_ns, 0) * 1e-9
        base = math.hypot(self.config.heading_sd_rad, drift)
        return min(math.hypot(base / max(horizontal, 1e-3), self._gap_sd_rad), math.pi)

    def _tick(self, stamp_ns: int) -> bool:
        period_ns = round(1e9 / self.config.output_rate_hz)
        if self._next_tick_ns is None:
            self._next_tick_ns = stamp_ns
        if stamp_ns < self._next_tick_ns:
            return False
        late = (stamp_ns - self._next_tick_ns) // period_ns
        self._next_tick_ns += (late + 1) * period_ns
        return True

    def _velocity(self, stamp_ns: int) -> StepVelocity:
        cfg, reference = self.config, self._attitude.reference
        if not self._rate_ok:
            return self._isotropic(stamp_ns, cfg.undecided_speed_sd_mps, True)
        if self._detector.still and self._turn_rate < cfg.still_rate_radps:
            return self._isotropic(stamp_ns, cfg.still_speed_sd_mps, False)
        step = self._step
        horizon_s = cfg.steps.max_interval_s + cfg.steps.delay_s
        if step is None or (stamp_ns - step.end_ns) * 1e-9 > horizon_s:
            return self._isotropic(stamp_ns, cfg.undecided_speed_sd_mps, True)
        duration_s = (step.end_ns - step.start_ns) * 1e-9
        velocity, cov = step_velocity(
            step.length_m, duration_s, step.heading_rad, step.length_sd_m, step.heading_sd_rad
        )
        stale = (cfg.speed_drift_mps2 * (stamp_ns - step.end_ns) * 1e-9) ** 2
        return StepVelocity(stamp_ns, velocity, cov + stale * np.eye(2), True, reference)

    def _isotropic(self, stamp_ns: int, sd_mps: float, moving: bool) -> StepVelocity:
        cov = sd_mps**2 * np.eye(2)
        return StepVelocity(stamp_ns, np.zeros(2), cov, moving, self._attitude.reference)
