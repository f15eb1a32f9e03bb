"""Attitude from gyro, accelerometer and optional magnetometer.

Tilt and gyro bias are those of VQF (D. Laidig, T. Seel, "VQF: Highly accurate IMU orientation
estimation with bias estimation and magnetic disturbance rejection", Information Fusion 91, 2023;
the package ``vqf``): the specific force is averaged in axes that do not turn, where the
accelerations of fast motion cancel. The magnetometer corrects heading only, so that a disturbed
field cannot tilt the estimate. A field whose norm, dip or heading contradicts what came before is
not used: iron beside the way may turn the horizontal field by tens of degrees where norm and dip
hardly change.

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
from vqf import VQF

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
    tilt_time_s: float = positive(3.0, "time constant of the accelerometer's hold on the tilt")
    heading_gain_per_s: float = not_negative(
        0.11, "gain of the magnetometer on the heading: one over the 9 s of VQF"
    )
    max_bias_radps: float = positive(0.1, "largest gyro bias per axis")
    gravity_tolerance_mps2: float = positive(
        3.0, "a first mean force further from 1 g than this is no gravity"
    )
    rest_gyro_radps: float = positive(0.15, "first attitude: a body at rest turns slower")
    rest_acceleration_sd_mps2: float = positive(0.15, "first attitude: a body at rest shakes less")
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


def _about_up(angle_rad: float) -> Quaternion:
    return (math.cos(0.5 * angle_rad), 0.0, 0.0, math.sin(0.5 * angle_rad))


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

    Alignment checks that the mean specific force is gravity. When the window is at rest its mean
    angular rate becomes the gyro bias. Heading is relative until the first accepted magnetic
    sample.
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
            self._reference: HeadingReference = "relative"
            self._field: tuple[float, float] | None = None  # norm [T], dip [rad]
            self._last_field_ns: int | None = None
            self._heading_sd = self._cfg.first_heading_sd_rad
            self._heading_used_ns = 0
        self._restart_heading = kept
        self.alignment_failed = False  # the last window had no plausible gravity
        self._q = None
        self._vqf: VQF | None = None
        self._period_s = 0.0  # of a sample, as VQF has it
        self._last_ns = 0
        self._turned = 0.0  # from the heading of VQF
        self._bias_array = np.array(self._bias)
        self._gyro, self._force = np.empty(3), np.empty(3)
        self._window: list[tuple[int, Vector, Vector]] = []

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
        """Propagate by one finite sample with a later stamp; True when aligned.

        rate : rad/s, body. force : specific force, m/s^2, body.
        """
        if self._vqf is None:
            return self._align(stamp_ns, rate, force)
        dt = (stamp_ns - self._last_ns) * 1e-9
        self._last_ns = stamp_ns
        # VQF takes one period for all samples: a rate that turns as far in that is given to it.
        stretch = dt / self._period_s
        self._gyro[:] = rate
        self._gyro *= stretch
        self._gyro += (1.0 - stretch) * self._bias_array
        self._force[:] = force
        self._vqf.updateGyr(self._gyro)
        self._vqf.updateAcc(self._force)
        self._take(self._vqf)
        return True

    def _take(self, vqf: VQF) -> None:
        """Copy attitude and bias of VQF."""
        w, x, y, z = vqf.getQuat6D().tolist()
        self._q = multiply(_about_up(self._turned), (w, x, y, z))
        bias, _ = vqf.getBiasEstimate()
        self._bias_array = bias
        bx, by, bz = bias.tolist()
        self._bias = (bx, by, bz)

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
        sample_attitude = quaternion if quaternion is not None else self._q
        mx, my, mz = rotate(sample_attitude, field_tesla)
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

    def turn(self, angle_rad: float) -> None:
        """Turn the attitude about map z (up), counter-clockwise."""
        if self._q is not None:
            self._turned += angle_rad
            self._q = multiply(_about_up(angle_rad), self._q)

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
        self._window.append((stamp_ns, rate, force))
        self.alignment_failed = False
        start_ns = self._window[0][0]
        if (stamp_ns - start_ns) * 1e-9 < self._cfg.alignment_time_s:
            return False
        window, self._window = self._window, []
        rates = np.array([sample[1] for sample in window])
        forces = np.array([sample[2] for sample in window])
        mean_rate, mean_force = rates.mean(axis=0), forces.mean(axis=0)
        cfg, gravity = self._cfg, float(np.linalg.norm(mean_force))
        if abs(gravity - GRAVITY_MPS2) > cfg.gravity_tolerance_mps2:
            self.alignment_failed = True
            return False  # wrong unit, free fall or shaking: try the next window
        sd, turn = math.sqrt(float(forces.var(axis=0).sum())), float(np.linalg.norm(mean_rate))
        rest = sd < cfg.rest_acceleration_sd_mps2 and len(window) > 2
        if rest and turn < min(cfg.rest_gyro_radps, cfg.max_bias_radps):
            bx, by, bz = mean_rate.tolist()
            self._bias = (bx, by, bz)
        fx, fy, fz = mean_force.tolist()
        self._begin([stamp for stamp, _, _ in window], rates, forces)
        self._turn_to(level((fx, fy, fz)))
        return True

    def _begin(self, stamps_ns: list[int], rates: Array, forces: Array) -> None:
        """Start VQF with the samples (n, 3) of the first window."""
        self._period_s = (stamps_ns[-1] - stamps_ns[0]) * 1e-9 / (len(stamps_ns) - 1)
        self._last_ns = stamps_ns[-1]
        self._vqf = VQF(
            self._period_s,
            tauAcc=self._cfg.tilt_time_s,
            biasClip=math.degrees(self._cfg.max_bias_radps),
        )
        self._bias_array = np.array(self._bias)
        self._vqf.setBiasEstimate(self._bias_array, -1.0)
        for rate, force in zip(rates, forces, strict=True):
            self._vqf.updateGyr(rate)
            self._vqf.updateAcc(force)
        self._take(self._vqf)

    def _turn_to(self, attitude: Quaternion) -> None:
        """Turn about map z so that the heading is that of ``attitude``, turned by what is kept."""
        w, x, y, z = self.quaternion
        tw, _, _, tz = multiply(attitude, (w, -x, -y, -z))
        self.turn(2.0 * math.atan2(tz, tw) + self._restart_heading)
