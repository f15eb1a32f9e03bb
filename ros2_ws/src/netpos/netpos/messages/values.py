"""Plain values that the parts of netpos exchange.

Stamps are integer nanoseconds of network time. Positions are metres in ``map`` (east, north, up),
angles radians. Nobody changes a value that exists; what streams is not frozen all the same, as
that would make it five times as slow to build.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Field(IntFlag):
    """Quantities a measurement may carry (RsuMeasurement.fields)."""

    AZIMUTH = 1
    ELEVATION = 2
    TOA = 4
    RANGE = 8
    PHASE = 16
    POSITION = 32
    TDOA = 64


class AngleConvention(IntEnum):
    """What azimuth means (RsuInfo.angle_convention)."""

    SPHERICAL = 0  # atan2(y, x) in the RSU's axes
    CONE = 1  # sin(azimuth) = y / |d|, the direction cosine a linear array measures


class TrackState(IntEnum):
    """Health of a track (TrackStatus.state)."""

    WAITING = 0
    INITIALISING = 1
    TRACKING = 2
    COASTING = 3
    AMBIGUOUS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class RsuInfo:
    """A roadside unit: where it is, and its slow errors. 0 means that there is no such error.

    Biases are first-order Gauss-Markov processes with the given sd and correlation time.

    Parameters
    ----------
    rsu_id : name, as in its measurements
    frame_id : frame of the pose
    position : (3,) m
    quaternion : (4,) x y z w, from the axes of the RSU (x boresight, y left, z up) to the frame
    network : of several networks the one it belongs to
    azimuth_bias_sd_rad : sd of the bias of its azimuths (CONE: of the direction cosine)
    elevation_bias_sd_rad : sd of the bias of its elevations
    range_bias_sd_m : sd of the bias of its ranges and arrival times
    bias_correlation_time_s : of these three
    common_range_bias_sd_m : sd of a range bias that all RSUs of the network share, such as the
        delay of the device's antenna
    common_bias_correlation_time_s : of that one
    noise_correlation_time_s : power spectral density at 0 of the other noise over its variance;
        0 is white noise
    angle_convention : ``RsuInfo.SPHERICAL``, azimuth is atan2(y, x) in the axes of the RSU, or
        ``RsuInfo.CONE``, its sine is y / distance, what a linear array measures
    baseline_m : distance of two antennas whose phases are compared
    wavelength_m : of the carrier of these phases
    stamp_ns : when it was described
    """

    SPHERICAL: ClassVar[AngleConvention] = AngleConvention.SPHERICAL
    CONE: ClassVar[AngleConvention] = AngleConvention.CONE

    rsu_id: str
    frame_id: str = "map"
    position: Array
    quaternion: Array = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))
    network: str = ""
    azimuth_bias_sd_rad: float = 0.0
    elevation_bias_sd_rad: float = 0.0
    range_bias_sd_m: float = 0.0
    bias_correlation_time_s: float = 0.0
    common_range_bias_sd_m: float = 0.0
    common_bias_correlation_time_s: float = 0.0
    noise_correlation_time_s: float = 0.0
    angle_convention: AngleConvention = AngleConvention.SPHERICAL
    baseline_m: float = 0.0
    wavelength_m: float = 0.0
    stamp_ns: int = 0


@dataclass(slots=True, kw_only=True)
class RsuMeasurement:
    """What one RSU measured of one device at one instant, each value with its variance.

    Parameters
    ----------
    stamp_ns : network time of the instant, > 0
    rsu_id : the RSU
    vue_id : the device
    sequence : number of the beacon, the same for all RSUs
    expected : how many RSUs report this instant; 0: unknown
    fields : the quantities that count: ``RsuMeasurement.AZIMUTH``, ``ELEVATION``, ``TOA``,
        ``TDOA``, ``RANGE``, ``PHASE``, ``POSITION``; several are joined by ``|``
    line_of_sight : whether the path is free, as far as the RSU knows
    rssi_dbm : received power, for people
    azimuth_rad : direction to the device in the axes of the RSU, counter-clockwise
    elevation_rad : direction to the device, up
    toa_s : distance / c + offset of the device's clock
    range_m : two-way range, free of the device's clock
    phase_difference_rad : of two antennas, in [-pi, pi)
    tdoa_s : time of arrival minus that at ``reference_rsu_id``
    lever_arm : m, the antenna that was measured in base_link of the device
    frame_id : frame of ``position``
    position : (3,) m, a fix of the network, with covariance ``position_cov`` (3, 3) m^2
    """

    AZIMUTH: ClassVar[Field] = Field.AZIMUTH
    ELEVATION: ClassVar[Field] = Field.ELEVATION
    TOA: ClassVar[Field] = Field.TOA
    RANGE: ClassVar[Field] = Field.RANGE
    PHASE: ClassVar[Field] = Field.PHASE
    POSITION: ClassVar[Field] = Field.POSITION
    TDOA: ClassVar[Field] = Field.TDOA

    stamp_ns: int
    rsu_id: str
    vue_id: str
    sequence: int = 0
    expected: int = 0
    fields: Field = Field(0)  # noqa: RUF009 - an immutable flag
    line_of_sight: bool = True
    rssi_dbm: float = 0.0
    azimuth_rad: float = 0.0
    azimuth_var: float = 0.0
    elevation_rad: float = 0.0
    elevation_var: float = 0.0
    toa_s: float = 0.0
    toa_var: float = 0.0
    range_m: float = 0.0
    range_var: float = 0.0
    phase_difference_rad: float = 0.0
    phase_difference_var: float = 0.0
    tdoa_s: float = 0.0
    tdoa_var: float = 0.0
    reference_rsu_id: str = ""
    """The RSU that ``tdoa_s`` counts from; with another one it is another measurement."""
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame_id: str = "map"
    position: Array = field(default_factory=lambda: np.zeros(3))
    position_cov: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(slots=True, kw_only=True)
class Velocity:
    """A horizontal velocity in the axes of ``frame_id``. velocity (2,) m/s, cov (2, 2)."""

    stamp_ns: int
    vue_id: str
    frame_id: str = "map"
    velocity: Array
    cov: Array
    source: str = "step_velocity"


@dataclass(slots=True, kw_only=True)
class GroundSpeed:
    """Speed over ground of a device [m/s] with its variance, whatever the direction (wheels,
    Doppler)."""

    stamp_ns: int
    vue_id: str
    speed_mps: float
    speed_var: float
    source: str = "ground_speed"


@dataclass(slots=True, kw_only=True)
class InitialPose:
    """A position handed to the tracker from outside. position (3,) m, cov (3, 3) m^2, both in
    ``frame_id``."""

    stamp_ns: int
    vue_id: str
    frame_id: str = "map"
    position: Array
    cov: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Beacon:
    """One simulated uplink emission: true antenna position (3,) m and device clock offset."""

    stamp_ns: int
    vue_id: str
    sequence: int
    position: Array
    clock_offset_s: float


UNKNOWN_HEIGHT_VAR = 1.0
"""Variance [m^2] of a height in an ``Odometry`` of which nothing is known but what was assumed."""


@dataclass(slots=True, kw_only=True)
class Odometry:
    """Pose and twist of a device, true or estimated.

    position (3,) m in map; quaternion (4,) x y z w, base_link to map; pose_cov (6, 6) in map axes;
    linear_velocity and angular_velocity (3,) in base_link axes (m/s, rad/s); twist_cov (6, 6) in
    base_link axes.
    """

    stamp_ns: int
    vue_id: str
    position: Array
    quaternion: Array
    linear_velocity: Array
    angular_velocity: Array = field(default_factory=lambda: np.zeros(3))
    pose_cov: Array = field(default_factory=lambda: np.zeros((6, 6)))
    twist_cov: Array = field(default_factory=lambda: np.zeros((6, 6)))


@dataclass(slots=True, kw_only=True)
class ClockState:
    """Device clock against network time: offset s, drift s/s, cov (2, 2)."""

    stamp_ns: int
    vue_id: str
    offset_s: float
    drift: float
    cov: Array = field(default_factory=lambda: np.zeros((2, 2)))


@dataclass(frozen=True, slots=True, kw_only=True)
class StepCalibration:
    """What a track has learned of a person's steps: true over reported length, angle from
    reported to true heading; sd 0: not estimated."""

    length_factor: float = 1.0
    length_factor_sd: float = 0.0
    heading_offset_rad: float = 0.0
    heading_offset_sd_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackMode:
    """One of several places where a device may be: its probability and its position in map."""

    weight: float
    x_m: float
    y_m: float


@dataclass(slots=True, kw_only=True)
class TrackStatus:
    """Health of one track at one epoch; counts since start."""

    stamp_ns: int
    vue_id: str
    state: TrackState
    nis: float = 0.0
    nis_dof: int = 0
    used: int = 0
    accepted: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    position_sd_m: float = 0.0
    protection_level_m: float = -1.0
    steps: StepCalibration = StepCalibration()
    modes: tuple[TrackMode, ...] = ()
    """While it is AMBIGUOUS: the modes that matter, the most probable first."""
    reason: str = ""
    """Why it is not TRACKING, for people."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RsuErrors:
    """What is learned of the errors of one RSU from one device, quantity by quantity.

    scatter : sd of single values over the one stated; bias, bias_sd, bias_spread : m or rad, how
    much too large the values are now, the sd of that, and the sd of the bias over time
    stretch, stretch_sd : by which share all distances that the device's track hears are too long,
    and the sd of that; 0 of what is no distance
    """

    stamp_ns: int
    rsu_id: str
    vue_id: str
    quantities: tuple[str, ...]
    scatter: tuple[float, ...]
    bias: tuple[float, ...]
    bias_sd: tuple[float, ...]
    bias_spread: tuple[float, ...]
    correlation_time_s: tuple[float, ...]
    stretch: tuple[float, ...]
    stretch_sd: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkTrack:
    """A device as the tracker of one network sees it at one epoch.

    mean : (6,) x, y m, vx, vy m/s, ax, ay m/s^2 in ``frame_id``; cov : (6, 6)
    own_cov : (6, 6) the part of cov that this network's own measurement noise made; 0: not known
    ``vue_id`` is the network's own name of the device, ``segment`` counts the track's new starts.
    """

    stamp_ns: int
    network: str
    vue_id: str
    mean: Array
    cov: Array
    own_cov: Array = field(default_factory=lambda: np.zeros((6, 6)))
    segment: int = 0
    frame_id: str = "map"
    height_m: float = 0.0

    @property
    def source(self) -> str:
        """Who reports: a network and its name of the device."""
        return f"{self.network}/{self.vue_id}"


@dataclass(slots=True, kw_only=True)
class ImuSample:
    """angular_velocity (3,) rad/s and specific_force (3,) m/s^2 in base_link; variances per axis
    (0: unknown)."""

    stamp_ns: int
    vue_id: str
    angular_velocity: Array
    specific_force: Array
    angular_velocity_var: float = 0.0
    specific_force_var: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MagneticSample:
    """magnetic_field (3,) tesla in base_link; variance per axis (0: unknown)."""

    stamp_ns: int
    vue_id: str
    magnetic_field: Array
    magnetic_field_var: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One detected step of a pedestrian."""

    stamp_ns: int
    vue_id: str
    frame_id: str = "map"
    start_ns: int
    end_ns: int
    count: int
    length_m: float
    length_var: float
    heading_rad: float
    heading_var: float
    cadence_hz: float
