"""Attitude from gyro, accelerometer and optional magnetometer: explicit complementary filter.

R. Mahony, T. Hamel, J.-M. Pflimlin, "Nonlinear complementary filters on the special orthogonal
group", IEEE Trans. Automatic Control 53(5), 2008, eqs. 47-48 (passive form with bias), with two
changes usual in walking: the accelerometer is down-weighted when it does not measure 1 g, and
the magnetometer corrects heading only, so that a disturbed field cannot tilt the estimate.
A field whose norm, dip or heading contradicts what came before is not used: iron beside the way
may turn the horizontal field by tens of degrees where norm and dip hardly change.

    q' = q * (0, w - b + kp e) / 2,   b' = -ki e,   e = f/|f| x R' z            (A1)
    heading error  d = (pi/2 - declination) - atan2(m_north, m_east)            (A2)
    used while |d| <= 3 sqrt(s^2 + s_m^2); s grows by ``gyro_heading_drift_radps`` t and falls
    with the gain to s_m / 2 as samples are used                                (A3)

Body is FLU, map is ENU, quaternions are (w, x, y, z) body -> map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from netpos.common.parameters import check_fields, not_negative, positive, real

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
HeadingReference = Literal["map", "relative"]
MagneticResult = Literal["used", "not_aligned", "field_vertical", "disturbed"]

GRAVITY_MPS2 = 9.80665


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeConfig:
    """Gains and gates of ``AttitudeFilter``; a bad value raises ``ValueError`` here."""

    alignment_time_s: float = positive(0.5, "the first attitude is the mean over this long")
    tilt_gain_per_s: float = not_negative(0.3, "gain of the accelerometer on the tilt")
    bias_gain_per_s2: float = not_negative(0.003, "gain of the accelerometer on the gyro bias")
    heading_gain_per_s: float = not_negative(0.3, "gain of the magnetometer on the heading")
    max_bias_radps: float = positive(0.1, "largest gyro bias per axis")
    acceleration_gate_mps2: float = positive(
        2.0, "a specific force this far from 1 g says nothing of the tilt"
    )
    gravity_tolerance_mps2: float = positive(
        3.0, "a first mean force further from 1 g than this is no gravity"
    )
    rest_gyro_radps: float = positive(0.15, "first attitude: a body at rest turns slower")
    rest_acceleration_sd_mps2: float = positive(0.15, "first attitude: a body at rest shakes less")
    rest_bias_memory_s: float = positive(15.0, "the gyro bias is the mean of this much rest")
    rest_bias_gate_radps: float = positive(
        0.02, "a rate at rest further from the known bias than this is a turn"
    )
    declination_rad: float = real(
        0.0, -math.pi, math.pi, "magnetic declination, east of north positive"
    )
    field_tolerance: float = positive(
        0.25, "share by which the norm of an undisturbed field may differ from the local one"
    )
    dip_tolerance_rad: float = positive(0.26, "the same of its dip [rad]")
    field_memory_s: float = positive(15.0, "how slowly the local field is followed")
    magnetic_heading_sd_rad: float = positive(0.09, "heading sd of a magnetic sample")
    first_heading_sd_rad: float = positive(0.5, "heading sd of the first sample of a field")
    gyro_heading_drift_radps: float = positive(
        0.005, "growth of the heading sd without field samples"
    )

    def __post_init__(self) -> None:
        check_fields(self, "attitude.")


def wrap_angle(angle_rad: float) -> float:
    """Wrap to [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product ``a * b``: rotate by ``b``, then by ``a``."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def rotate(q: Quaternion, v: Vector) -> Vector:
    """``R(q) v``: body -> map for a body -> map quaternion."""
    w, x, y, z = q
    tx = 2.0 * (y * v[2] - z * v[1])
    ty = 2.0 * (z * v[0] - x * v[2])
    tz = 2.0 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


def _exponential(v: Vector) -> Quaternion:
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    s = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return (math.cos(0.5 * angle), v[0] * s, v[1] * s, v[2] * s)


def _normalised(q: Quaternion) -> Quaternion:
    n = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] / n, q[1] / n, q[2] / n, q[3] / n)


def level(specific_force: Vector, forward: Vector = (1.0, 0.0, 0.0)) -> Quaternion:
    """Attitude that puts ``specific_force`` up and the ``forward`` body axis over map x.

    Parameters
    ----------
    specific_force : body frame, any unit, not zero
    forward : body axis whose horizontal part defines heading 0; when it is within 0.6 deg of
        the vertical the body z axis takes its place, so the result is always a rotation

    Raises
    ------
    ValueError  the specific force is zero or not finite
    """
    up = np.asarray(specific_force, dtype=np.float64)
    norm = float(np.linalg.norm(up))
    if not 0.0 < norm < math.inf:
        raise ValueError(f"specific force must be finite and not zero, got {specific_force}")
    up = up / norm
    axis = np.asarray(forward, dtype=np.float64)
    if float(np.linalg.norm(np.cross(up, axis))) < 0.01:
        axis = np.array([0.0, 0.0, 1.0])
    east = axis - up * float(up @ axis)
    east /= float(np.linalg.norm(east))
    matrix = np.stack([east, np.cross(up, east), up])  # rows: map axes seen from the body
    x, y, z, w = Rotation.from_matrix(matrix).as_quat().tolist()
    return (w, x, y, z)


class AttitudeFilter:
    """Streaming orientation; aligns on the first ``alignment_time_s`` of samples.

    Alignment takes the mean specific force as up. When the window is at rest its mean
    angular rate becomes the gyro bias; otherwise the bias starts at zero and the tilt gain
    pulls the error out. Heading is relative until the first accepted magnetic sample.
    """

    def __init__(self, config: AttitudeConfig | None = None) -> None:
        self._cfg = config if config is not None else AttitudeConfig()
        self._q: Quaternion | None = None
        self.reset()

    def reset(self, *, keep_heading: bool = False) -> None:
        """Forget the attitude; with ``keep_heading`` only the tilt is aligned afresh."""
        kept = self.heading_rad if keep_heading and self.aligned else 0.0
        if not keep_heading:
            self._bias: Vector = (0.0, 0.0, 0.0)
            self._rest_s = 0.0  # how much rest the bias is the mean of
            self._reference: HeadingReference = "relative"
            self._field: tuple[float, float] | None = None  # norm [T], dip [rad]
            self._last_field_ns: int | None = None
            self._heading_sd = self._cfg.first_heading_sd_rad
            self._heading_used_ns = 0
        self._restart_heading = kept
        self.alignment_failed = False  # the last window had no plausible gravity
        self._q = None
        self._last_ns: int | None = None
        self._start_ns: int | None = None
        self._n = 0
        self._sum = np.zeros(6)
        self._sum_sq = np.zeros(3)

    @property
    def aligned(self) -> bool:
        return self._q is not None

    @property
    def reference(self) -> HeadingReference:
        """``"map"`` once a magnetometer has fixed the heading, else ``"relative"``."""
        return self._reference

    @property
    def bias_radps(self) -> Vector:
        return self._bias

    @property
    def quaternion(self) -> Quaternion:
        """(w, x, y, z) body -> map; identity before alignment (see ``aligned``)."""
        return self._q if self._q is not None else (1.0, 0.0, 0.0, 0.0)

    @property
    def rotation(self) -> Rotation:
        w, x, y, z = self.quaternion
        return Rotation.from_quat([x, y, z, w])

    @property
    def forward(self) -> tuple[float, float]:
        """Horizontal part of the body x axis in the map; its norm is cos(pitch)."""
        w, x, y, z = self.quaternion
        return (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z))

    @property
    def heading_rad(self) -> float:
        """Direction of the body x axis, counter-clockwise from map x, [-pi, pi)."""
        x, y = self.forward
        return wrap_angle(math.atan2(y, x))

    def add_imu(self, stamp_ns: int, rate: Vector, force: Vector) -> bool:
        """Propagate by one finite sample with a later stamp; True when aligned (A1).

        rate : rad/s, body. force : specific force, m/s^2, body.
        """
        if self._q is None:
            return self._align(stamp_ns, rate, force)
        dt = (stamp_ns - self._last_ns) * 1e-9 if self._last_ns is not None else 0.0
        self._last_ns = stamp_ns
        ex, ey, ez = self._tilt_error(self._q, force)
        kp = min(self._cfg.tilt_gain_per_s, 1.0 / dt) if dt > 0 else 0.0
        ki, limit = self._cfg.bias_gain_per_s2 * dt, self._cfg.max_bias_radps
        bx, by, bz = self._bias
        bx = min(max(bx - ki * ex, -limit), limit)
        by = min(max(by - ki * ey, -limit), limit)
        bz = min(max(bz - ki * ez, -limit), limit)
        self._bias = (bx, by, bz)
        step = (
            (rate[0] - bx + kp * ex) * dt,
            (rate[1] - by + kp * ey) * dt,
            (rate[2] - bz + kp * ez) * dt,
        )
        self._q = _normalised(multiply(self._q, _exponential(step)))
        return True

    def add_magnetic_field(
        self, stamp_ns: int, field_tesla: Vector, quaternion: Quaternion | None = None
    ) -> MagneticResult:
        """Correct heading with one finite field sample in the body frame (A2). ``quaternion`` is
        the attitude it was taken at, where that is not the present one.

        The first accepted sample sets the heading. A sample whose norm or dip differs from
        the running field by more than the tolerances is ``"disturbed"`` and not used.
        """
        if self._q is None:
            return "not_aligned"
        taken_at = quaternion if quaternion is not None else self._q
        mx, my, mz = rotate(taken_at, field_tesla)
        horizontal = math.hypot(mx, my)
        norm = math.hypot(horizontal, mz)
        if horizontal <= 0.05 * norm:
            return "field_vertical"
        previous_ns = self._last_field_ns
        disturbed = self._disturbed(stamp_ns, norm, math.atan2(-mz, horizontal))
        if disturbed and self._reference == "map":
            return "disturbed"
        error = wrap_angle(math.pi / 2 - self._cfg.declination_rad - math.atan2(my, mx))
        gain = 1.0
        if self._reference == "map" and previous_ns is not None:
            if self._contradicts(stamp_ns, error):
                return "disturbed"
            dt = min(max((stamp_ns - previous_ns) * 1e-9, 0.0), 0.1)
            gain = min(self._cfg.heading_gain_per_s * dt, 1.0)
            floor = 0.5 * self._cfg.magnetic_heading_sd_rad
            self._heading_sd += gain * (floor - self._heading_sd)
        else:
            self._heading_sd = self._cfg.first_heading_sd_rad
        self._heading_used_ns = stamp_ns
        self._reference = "map"
        self.turn(gain * error)
        return "used"

    def rest(self, dt_s: float, rate: Vector) -> None:
        """Learn the gyro bias from a sample at rest, the ``dt_s`` after the last one: the mean of
        all rest, or of about the last ``rest_bias_memory_s`` of it.

        A rate further than ``rest_bias_gate_radps`` from the present bias is a turn, not rest.
        """
        bx, by, bz = self._bias
        x, y, z = rate[0] - bx, rate[1] - by, rate[2] - bz
        if self._q is None or max(abs(x), abs(y), abs(z)) > self._cfg.rest_bias_gate_radps:
            return
        self._rest_s = min(self._rest_s + dt_s, self._cfg.rest_bias_memory_s)
        a = dt_s / self._rest_s if dt_s > 0 else 0.0
        self._bias = (bx + a * x, by + a * y, bz + a * z)

    def turn(self, angle_rad: float) -> None:
        """Turn the attitude about map z (up), counter-clockwise."""
        if self._q is not None:
            self._q = _normalised(multiply(_exponential((0.0, 0.0, angle_rad)), self._q))

    def _tilt_error(self, q: Quaternion, force: Vector) -> Vector:
        norm = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
        weight = 1.0 - abs(norm - GRAVITY_MPS2) / self._cfg.acceleration_gate_mps2
        if weight <= 0.0 or norm == 0.0:
            return (0.0, 0.0, 0.0)
        w, x, y, z = q
        ux, uy, uz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        s = weight / norm
        fx, fy, fz = force[0] * s, force[1] * s, force[2] * s
        return (fy * uz - fz * uy, fz * ux - fx * uz, fx * uy - fy * ux)

    def _disturbed(self, stamp_ns: int, norm: float, dip: float) -> bool:
        """Compare with, then slowly follow, the local field (it changes along a building)."""
        if self._field is None or self._last_field_ns is None:
            self._field, self._last_field_ns = (norm, dip), stamp_ns
            return False
        dt = min(max((stamp_ns - self._last_field_ns) * 1e-9, 0.0), 1.0)
        self._last_field_ns = stamp_ns
        norm0, dip0 = self._field
        a = min(dt / self._cfg.field_memory_s, 1.0)
        self._field = (norm0 + a * (norm - norm0), dip0 + a * (dip - dip0))
        return (
            abs(norm - norm0) > self._cfg.field_tolerance * norm0
            or abs(dip - dip0) > self._cfg.dip_tolerance_rad
        )

    def _contradicts(self, stamp_ns: int, error_rad: float) -> bool:
        """Whether a magnetic heading is too far from the one kept by the gyro (A3)."""
        since_s = max(stamp_ns - self._heading_used_ns, 0) * 1e-9
        kept_sd = self._heading_sd + self._cfg.gyro_heading_drift_radps * since_s
        return abs(error_rad) > 3.0 * math.hypot(kept_sd, self._cfg.magnetic_heading_sd_rad)

    def _align(self, stamp_ns: int, rate: Vector, force: Vector) -> bool:
        if self._start_ns is None:
            self._start_ns = stamp_ns
        self._n += 1
        self._sum += np.array([*rate, *force])
        self._sum_sq += np.square(np.array(force))
        self._last_ns = stamp_ns
        self.alignment_failed = False
        if (stamp_ns - self._start_ns) * 1e-9 < self._cfg.alignment_time_s:
            return False
        mean = self._sum / self._n
        sd = math.sqrt(max(float(np.sum(self._sum_sq / self._n - mean[3:] ** 2)), 0.0))
        start, self._start_ns, n = self._restart_heading, None, self._n
        self._n, self._sum, self._sum_sq = 0, np.zeros(6), np.zeros(3)
        norm = float(np.linalg.norm(mean[3:]))
        if abs(norm - GRAVITY_MPS2) > self._cfg.gravity_tolerance_mps2:
            self.alignment_failed = True
            return False  # wrong unit, free fall or shaking: try the next window
        cfg = self._cfg
        rest = sd < cfg.rest_acceleration_sd_mps2 and n > 2
        rate_norm = float(np.linalg.norm(mean[:3]))
        if rest and rate_norm < min(cfg.rest_gyro_radps, cfg.max_bias_radps):
            self._bias = (float(mean[0]), float(mean[1]), float(mean[2]))
            self._rest_s = cfg.alignment_time_s
        self._q = level((float(mean[3]), float(mean[4]), float(mean[5])))
        self.turn(start)
        return True
