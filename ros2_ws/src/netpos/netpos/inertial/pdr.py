"""Pedestrian dead reckoning: IMU samples in, steps and the mean velocity of the last step out.

Without a step the pseudo-measurement is zero velocity; it is stated tightly only when the
accelerometer and gyro are quiet, less so when the body turns on the spot. In between (start of a
walk, handling, a single step) the velocity is unknown: zero with ``undecided_speed_sd_mps`` and
``moving`` True.

Time is the stamp of the samples; there is no clock. Bad data never raises: it is counted in
``PedestrianDeadReckoning.counters`` under its reason, and a lasting condition is reported once
(``take_notices``).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from netpos.inertial.attitude import (
    AttitudeFilter,
    Quaternion,
    wrap_angle,
)
from netpos.inertial.length import LengthScale, frequency_length, weinberg_length
from netpos.inertial.pdr_config import PdrConfig
from netpos.inertial.pdr_output import PdrOutput, StepEvent, StepVelocity, step_velocity
from netpos.inertial.steps import LONGEST_STEP, Step, StepDetector
from netpos.inertial.watch import Conditions, StreamWatch
from netpos.messages.fields import bad_stamp, malformed_nanosec

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float]
VectorLike = npt.NDArray[np.floating] | Sequence[float]


def _vector(value: VectorLike) -> Vector | str:
    """Three finite floats, or the reason why not."""
    try:
        x, y, z = (float(v) for v in value)
    except (TypeError, ValueError):
        return "malformed"
    return (x, y, z) if math.isfinite(x + y + z) else "not_finite"


class PedestrianDeadReckoning:
    """Streaming core; see the module docstring for the model.

    ``counters`` keys: ``malformed``, ``not_finite``, ``bad_stamp`` (a nanosec of a second or
    more), ``stamp_duplicate``, ``stamp_backwards``, ``accelerometer_saturated``
    (used for steps, not for tilt), ``gyro_saturated`` (used, the heading less sure; either
    refused when beyond the range); ``gap``, ``clock_reset`` (restart);
    ``rate_out_of_range`` (per second of stream); ``gravity_implausible`` (an alignment window
    without 1 g: wrong unit?); ``magnetic_*`` (field sample not used).
    ``conditions``: ``rate``, ``axes``, ``gravity``, ``no_magnetic_field``, ``magnetic_disturbed``.
    """

    def __init__(self, config: PdrConfig | None = None) -> None:
        self.config = config if config is not None else PdrConfig()
        self._count = 0
        self._counters: Counter[str] = Counter()
        self._conditions = Conditions()
        self._watch = StreamWatch(self.config, self._conditions, self._counters)
        self._attitude = AttitudeFilter(self.config.attitude)
        self._detector = StepDetector(self.config.steps)
        self.length_scale = LengthScale(self.config.length_scale, self.config.length_scale_sd)
        """Of this person; ``observe`` references to calibrate it."""
        self._restart()

    @property
    def counters(self) -> dict[str, int]:
        return dict(self._counters)

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of what is wrong with the input now."""
        return self._conditions.active

    def take_notices(self) -> list[str]:
        """Sentences about the input since the last call; each condition is reported once."""
        return self._conditions.take()

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
        self._fields: deque[tuple[int, Vector]] = deque(maxlen=1000)
        self._attitudes: deque[tuple[int, Quaternion]] = deque(maxlen=1000)
        self._field_refused = False
        self._aligned_ns: int | None = None
        self._mounted = True
        self._restart_detector()

    def _restart_detector(self) -> None:
        self._detector.reset()
        self._step: StepEvent | None = None
        self._forward: deque[tuple[int, float, float]] = deque()
        self._turn_rate = math.inf
        self._resting = False  # as of the last output
        self._watch.reset()

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
            self._refuse(rate if isinstance(rate, str) else str(force))
            return None
        nanosec = malformed_nanosec(stamp_ns)
        if nanosec is not None:
            self._refuse("bad_stamp", bad_stamp(nanosec))
            return None
        if not self._in_order(stamp_ns):
            return None
        saturated = self._watch.saturated(rate, force)
        if saturated is not None and (saturated[1] or not self._attitude.aligned):
            return None
        dt_s = (stamp_ns - self._last_ns) * 1e-9 if self._last_ns is not None else 0.0
        if dt_s > self.config.max_gap_s:
            self._on_gap(dt_s)
        self._last_ns = stamp_ns
        self._use_fields(stamp_ns)
        self._watch.rate(stamp_ns)
        self._mounted = self._watch.mounted(dt_s, force)
        level = force
        if saturated is not None and saturated[0] == "accelerometer_saturated":
            level = (0.0, 0.0, 0.0)  # which way is up is not known
        elif saturated is not None:
            self._lose_heading(dt_s)
        if not self._update_attitude(stamp_ns, dt_s, rate, level):
            self._detector.add(stamp_ns, force)
            return None
        steps = [self._event(stamp_ns, s) for s in self._detector.add(stamp_ns, force)]
        if steps:
            self._step = steps[-1]
        velocity = None
        if self._tick(stamp_ns):
            self._resting = self._detector.still
            velocity = self._velocity(stamp_ns)
        return PdrOutput(tuple(steps), velocity) if steps or velocity is not None else None

    def add_magnetic_field(self, stamp_ns: int, field_tesla: VectorLike) -> None:
        """Add one magnetometer sample (3,) in tesla, body frame.

        A sample without 1-1000 microtesla (wrong unit), out of order, or of a time without
        attitude is counted and not used. It may arrive before the IMU samples of its time, and up
        to ``field_hold_s`` after them.
        """
        value = _vector(field_tesla)
        if malformed_nanosec(stamp_ns) is not None:
            value = "bad_stamp"
        if isinstance(value, str):
            self._counters[f"magnetic_{value}"] += 1
            return
        if not 1e-6 < math.sqrt(sum(v * v for v in value)) < 1e-3:
            self._counters["magnetic_out_of_range"] += 1
            return
        if self._last_field_ns is not None and stamp_ns <= self._last_field_ns:
            self._counters["magnetic_stamp_backwards"] += 1
            return
        self._last_field_ns = stamp_ns
        self._fields.append((stamp_ns, self._calibrated(value)))

    def _calibrated(self, value: Vector) -> Vector:
        x, y, z = (v - h for v, h in zip(value, self.config.hard_iron_t, strict=True))
        a, b, c, d, e, f, g, h, i = self.config.field_matrix
        return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)

    def _use_fields(self, now_ns: int) -> None:
        """Use the field samples that are old enough, each with the attitude of its stamp."""
        hold_ns = round(self.config.field_hold_s * 1e9)
        while self._fields and self._fields[0][0] + hold_ns <= now_ns:
            stamp_ns, value = self._fields.popleft()
            while len(self._attitudes) > 1 and self._attitudes[1][0] <= stamp_ns:
                self._attitudes.popleft()
            if not self._attitudes or self._attitudes[0][0] > stamp_ns:
                self._counters["magnetic_not_aligned"] += 1
                continue
            was_relative = self._attitude.reference == "relative"
            sample_attitude = self._attitudes[0][1]
            result = self._attitude.add_magnetic_field(stamp_ns, value, sample_attitude)
            self._field_refused = result != "used"
            if self._field_refused:
                self._counters[f"magnetic_{result}"] += 1
                continue
            self._heading_fix_ns, self._gap_sd_rad = stamp_ns, 0.0
            if was_relative:  # the frame has just turned to east/north
                self._attitudes.clear()
                self._forward.clear()
                self._step = None

    def _in_order(self, stamp_ns: int) -> bool:
        last = self._last_ns
        if last is None or stamp_ns > last:
            return True
        if (last - stamp_ns) * 1e-9 < self.config.clock_reset_s:
            self._counters["stamp_duplicate" if stamp_ns == last else "stamp_backwards"] += 1
            return False
        self._counters["clock_reset"] += 1
        self._restart()
        return True

    def _refuse(
        self, reason: str, why: str = "IMU samples without three finite values are left out"
    ) -> None:
        """Count a sample that cannot be read, and report the first of a kind."""
        if not self._counters[reason]:
            self._conditions.tell(f"{reason}: {why}")
        self._counters[reason] += 1

    def _on_gap(self, dt_s: float) -> None:
        if not self._counters["gap"]:
            self._conditions.tell(
                f"a gap of {dt_s:.2f} s in the IMU stream (more than max_gap_s "
                f"{self.config.max_gap_s:g}): the heading is kept with a larger sd, steps start "
                "anew; further gaps are only counted"
            )
        self._counters["gap"] += 1
        self._lose_heading(dt_s)
        self._attitude.reset(keep_heading=True)
        self._attitudes.clear()
        self._restart_detector()

    def _lose_heading(self, unseen_s: float) -> None:
        """Widen the heading's sd by the turn that the samples may have missed."""
        unseen = self.config.gap_rate_sd_radps * unseen_s
        self._gap_sd_rad = min(math.hypot(self._gap_sd_rad, unseen), math.pi)

    def _update_attitude(self, stamp_ns: int, dt_s: float, rate: Vector, force: Vector) -> bool:
        was_aligned = self._attitude.aligned
        if not self._attitude.add_imu(stamp_ns, rate, force):
            if self._attitude.alignment_failed:
                self._counters["gravity_implausible"] += 1
                self._tell_gravity(True)
            return False
        if not was_aligned:
            self._tell_gravity(False)
            self._aligned_ns = stamp_ns
            if self._heading_fix_ns == 0:
                self._heading_fix_ns = stamp_ns
        self._watch_field(stamp_ns)
        self._attitudes.append((stamp_ns, self._attitude.quaternion))
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

    def _tell_gravity(self, implausible: bool) -> None:
        self._conditions.set(
            "gravity",
            implausible,
            "the mean specific force is not 9.8 m/s^2: is it in g, or without gravity? "
            "No attitude and no steps until it is",
            "the specific force is plausible now",
        )

    def _watch_field(self, stamp_ns: int) -> None:
        """Report when the heading had no magnetic field for a while, and why."""
        since_ns = max(self._heading_fix_ns, self._aligned_ns or 0)
        late = (stamp_ns - since_ns) * 1e-9 > self.config.field_patience_s
        heard = self._last_field_ns is not None and (
            (stamp_ns - self._last_field_ns) * 1e-9 <= self.config.field_patience_s
        )
        drift = f"its sd grows by {self.config.heading_drift_radps:g} rad/s"
        self._conditions.set(
            "no_magnetic_field",
            late and not heard,
            f"no magnetic field is heard: the heading comes from the gyro alone, {drift}. Is mag "
            "published with the stamps of the IMU?",
            "the magnetic field gives the heading again",
        )
        self._conditions.set(
            "magnetic_disturbed",
            late and heard and self._field_refused,
            f"the magnetic field is disturbed: the heading comes from the gyro alone, {drift}",
            "the magnetic field gives the heading again",
        )

    def _event(self, stamp_ns: int, step: Step) -> StepEvent:
        x, y = self._attitude.forward
        inside = [f for f in self._forward if step.start_ns <= f[0] <= step.end_ns]
        if inside:
            x = sum(f[1] for f in inside) / len(inside)
            y = sum(f[2] for f in inside) / len(inside)
        horizontal = math.hypot(x, y)
        heading = math.atan2(y, x) + self.config.mount_heading_rad
        length = self.length_scale.mean * self._model_length(step)
        scale_sd_fraction = self.length_scale.sd / self.length_scale.mean
        self._count += 1
        return StepEvent(
            stamp_ns=stamp_ns,
            start_ns=step.start_ns,
            end_ns=step.end_ns,
            count=self._count,
            length_m=length,
            heading_rad=wrap_angle(heading),
            heading_sd_rad=self._heading_sd(stamp_ns, horizontal),
            length_sd_m=math.hypot(scale_sd_fraction, self.config.step_sd_fraction) * length,
            cadence_hz=step.cadence_hz,
            heading_reference=self._attitude.reference,
        )

    def _model_length(self, step: Step) -> float:
        """Length of the person's step before the scale [m]."""
        if self.config.length_model == "weinberg":
            return weinberg_length(step.bounce_mps2, self.config.weinberg_k)
        return frequency_length(step.cadence_hz, self.config.height_m)

    def _heading_sd(self, stamp_ns: int, horizontal: float) -> float:
        """Heading sd; a nearly vertical forward axis (small ``horizontal``) spoils it."""
        if not self._mounted:
            return math.pi
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
        if not (self._watch.rate_ok and self._mounted):
            return self._isotropic(stamp_ns, cfg.undecided_speed_sd_mps, True)
        if self._resting:
            turning = self._turn_rate >= cfg.still_rate_radps
            sd = cfg.turning_speed_sd_mps if turning else cfg.still_speed_sd_mps
            return self._isotropic(stamp_ns, sd, turning)
        step = self._step
        if step is None:
            return self._isotropic(stamp_ns, cfg.undecided_speed_sd_mps, True)
        duration_s = (step.end_ns - step.start_ns) * 1e-9
        overdue_s = LONGEST_STEP * duration_s + cfg.steps.delay_s  # of the next step's detection
        if (stamp_ns - step.end_ns) * 1e-9 > overdue_s:
            return self._isotropic(stamp_ns, cfg.undecided_speed_sd_mps, True)
        velocity, cov = step_velocity(
            step.length_m, duration_s, step.heading_rad, step.length_sd_m, step.heading_sd_rad
        )
        stale = (cfg.speed_drift_mps2 * (stamp_ns - step.end_ns) * 1e-9) ** 2
        return StepVelocity(stamp_ns, velocity, cov + stale * np.eye(2), True, reference)

    def _isotropic(self, stamp_ns: int, sd_mps: float, moving: bool) -> StepVelocity:
        cov = sd_mps**2 * np.eye(2)
        return StepVelocity(stamp_ns, np.zeros(2), cov, moving, self._attitude.reference)
