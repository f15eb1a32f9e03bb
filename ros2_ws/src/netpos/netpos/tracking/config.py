"""Parameters of the tracker; the node and the command line take names, defaults and limits from
here."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, make_dataclass
from typing import Any

from netpos.common.parameters import check_fields, choice, count, described, from_mapping, real
from netpos.estimation.forms import table as forms
from netpos.estimation.motion import ProcessNoise
from netpos.estimation.motion import table as motion
from netpos.estimation.motion.model import MotionModel
from netpos.messages.fields import Frames
from netpos.tracking import shared_parameters as shared
from netpos.tracking.rsus.rsu import StepErrors
from netpos.world.geodesy import datum_of_text

FILTERS = tuple(forms.words())
STRAPDOWN = "strapdown"
"""The motion of a track in three dimensions, which is no model of the table."""
_MOTIONS = {**motion.words(), STRAPDOWN: "three dimensions, driven by the device's IMU"}
MOTION_MODELS = tuple(_MOTIONS)
ROBUST = ("none", "huber", "student_t")
TRUST = ("listed", "first", "any")
AMBIGUITY = ("hypotheses", "step_heading")


def _described(words: Mapping[str, str]) -> str:
    return " | ".join(f"{word} ({text})" if text else word for word, text in words.items())


def _of_the_tables() -> Any:
    """Dataclass of the parameters that the tables of motion models and filter forms give."""
    entries = {
        "filter": choice(forms.DEFAULT, FILTERS, _described(forms.words())),
        "motion_model": choice(motion.DEFAULT, MOTION_MODELS, _described(_MOTIONS)),
        **motion.parameters(),
        **forms.parameters(),
    }
    kinds = [(name, type(entry.default), entry) for name, entry in entries.items()]
    return make_dataclass("_OfTheTables", kinds, frozen=True, slots=True, kw_only=True)


_OfTheTables: Any = _of_the_tables()


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerConfig(_OfTheTables):  # type: ignore[misc]
    """Every parameter has its unit in its name, a range and a sentence
    (``dataclasses.fields(...).metadata``).

    Raises ``ValueError`` naming the parameter, its value and the accepted range.
    """

    process_noise: str = choice(
        "continuous",
        tuple(noise.name.lower() for noise in ProcessNoise),
        "continuous | werner (fokin2020:eq.4) | white_acceleration (eq.36)",
    )
    accel_density_mps2_sqrthz: float = real(
        0.0,
        0.0,
        1e3,
        "continuous: density of the white acceleration between manoeuvres [m/s^2/sqrt(Hz)]; 0:"
        " learned on the way, from 0.5 on; interacting: 0.5",
    )
    steady_accel_density_mps2_sqrthz: float = real(
        0.0,
        0.0,
        1e3,
        "continuous: the same while velocities in map are reported, well known and unchanged; not"
        " with an IMU; 0: not looked at",
    )
    accel_sd_mps2: float = real(1.0, 1e-6, 1e3, "white_acceleration: acceleration sd per step")
    velocity_step_sd_mps: float = real(0.1, 1e-9, 1e3, "werner: velocity sd per step")
    drift_step_sd: float = real(
        1e-4, 0.0, 1.0, "werner, white_acceleration: clock drift sd per step [s/s]"
    )
    sojourn_s: float = real(
        5.0, 1e-3, 1e6, "interacting: mean time a device keeps to one of the models"
    )
    inertial_accel_density_mps2_sqrthz: float = real(
        0.1,
        1e-6,
        1e3,
        "inertial: noise of the forward acceleration and side slip; strapdown: of each axis",
    )
    gyro_noise_density: float = real(
        5e-3, 1e-9, 10.0, "inertial, strapdown: noise of the gyros [rad/s/sqrt(Hz)]"
    )
    gyro_bias_sd_radps: float = real(
        0.01,
        1e-9,
        10.0,
        "inertial: initial sd of the yaw-rate bias; strapdown: sd of each gyro bias",
    )
    accel_bias_sd_mps2: float = real(
        0.2,
        1e-9,
        100.0,
        "inertial: initial sd of the forward acceleration's bias; strapdown: of each axis",
    )
    bias_correlation_time_s: float = real(
        100.0, 1.0, 1e6, "strapdown: correlation time of the IMU's biases (first-order Markov)"
    )
    sideways_sd_mps: float = real(
        0.0, 0.0, 10.0, "strapdown: a vehicle's speed to the side, ten times a second; 0: free"
    )
    upwards_sd_mps: float = real(
        0.0, 0.0, 10.0, "strapdown: a vehicle's speed off its floor, ten times a second; 0: free"
    )
    standstill_sd_mps: float = real(
        0.0, 0.0, 10.0, "strapdown: speed of a vehicle whose IMU is quiet; 0: not looked at"
    )
    still_force_mps2: float = real(
        0.2, 0.0, 100.0, "strapdown: a quiet IMU's specific force stays this close to its mean"
    )
    still_rate_radps: float = real(0.05, 0.0, 10.0, "strapdown: a quiet IMU turns slower")
    gravity_mps2: float = real(9.80665, 9.0, 11.0, "strapdown: gravity of the place")
    earth_rate: bool = described(False, "strapdown: the earth turns, as at latitude_deg")
    latitude_deg: float = real(0.0, -90.0, 90.0, "strapdown: of the place, with earth_rate")
    clock_white_density: float = real(
        1e-10, 0.0, 1.0, "continuous: clock white frequency noise [s/sqrt(s)]"
    )
    clock_walk_density: float = real(
        0.0,
        0.0,
        1.0,
        "continuous: clock random-walk frequency noise [(s/s)/sqrt(s)]; 0: learned on the way,"
        " starting at 5e-7; interacting, strapdown, kf or without manoeuvres: 5e-7",
    )
    clock_offset_sd_s: float = real(
        1e-4,
        0.0,
        1e3,
        "clock offset sd of a device just switched on, mean 0; a first fix takes any other that"
        " makes the times agree",
    )
    clock_drift_mean: float = real(25e-6, -1.0, 1.0, "initial clock drift [s/s]")
    clock_drift_sd: float = real(30e-6, 0.0, 1.0, "initial clock drift sd [s/s]")
    initial_speed_sd_mps: float = real(5.0, 1e-3, 1e3, "initial velocity sd per axis, mean 0")
    require_initial_pose: bool = described(
        False, "wait for initialpose instead of the first measurements"
    )
    initial_pose_wait_s: float = real(
        5.0, 0.0, 1e6, "with require_initial_pose: after this the track starts itself"
    )
    accept_initialpose: bool = described(
        True, "start anew at an initialpose that the measurements permit; false: refuse all"
    )
    initial_position_sd_max_m: float = real(
        5.0, 1e-3, 1e4, "a first fix is taken once its position sd is below this"
    )
    initial_window_s: float = real(3.0, 0.01, 60.0, "measurements used for the first fix")
    coverage_radius_m: float = real(
        150.0,
        1.0,
        1e5,
        "a device is about this far from the RSUs that hear it, or as far as these stand apart",
    )
    device_height_m: float = real(
        0.0, -1e4, 1e4, "height of the device in map; where it is unknown, of its mean"
    )
    device_height_sd_m: float = real(
        0.0, 0.0, 1e4, "sd of the device's height about its mean, estimated on the way; 0: known"
    )
    device_height_time_s: float = real(
        30.0, 0.1, 1e6, "correlation time of an unknown height (first-order Markov)"
    )
    gate_probability: float = real(
        0.9999, 0.5, 1.0, "share of true measurements the chi-square gate accepts; 1: no gate"
    )
    robust: str = choice(
        "none", ROBUST, "none | huber | student_t: what fits badly is fused with a larger variance"
    )
    robust_parameter: float = real(
        4.0, 0.1, 1e3, "huber: distance [sd] from which it grows; student_t: degrees of freedom"
    )
    nlos_probability: float = real(
        0.0, 0.0, 0.99, "share of ranges and times that come late by a blocked path; 0: none"
    )
    nlos_mean_excess_m: float = real(20.0, 1e-3, 1e5, "mean excess of a blocked path")
    nlos_memory: float = real(
        100.0,
        1.0,
        1e9,
        "measurements over which each RSU's share of blocked paths is learned",
    )
    ambiguity: str = choice(
        "hypotheses",
        AMBIGUITY,
        "how the sector of a phase difference is found: hypotheses (a component per sector)"
        " | step_heading (petukhov:eq.16-18, once per first fix)",
    )
    sector_slip_probability: float = real(
        1e-6, 1e-12, 1e-2, "hypotheses: least probability of a sector, so that a rival can return"
    )
    velocity_correlation_s: float = real(
        0.0,
        0.0,
        60.0,
        "velocities in map: power spectral density at 0 of their errors over their variance (the"
        " duration of a step where one error lasts a step); 0: white",
    )
    step_length_factor_sd: float = real(
        0.0,
        0.0,
        1.0,
        "velocities in map: sd of the logarithm of true over reported length of all steps of the"
        " person, estimated on the way, over what their covariance holds; 0: not estimated",
    )
    step_heading_offset_sd_rad: float = real(
        0.0,
        0.0,
        1.0,
        "velocities in map: sd of the angle from reported to true heading of all steps, estimated"
        " on the way, over what their covariance holds; 0: not estimated",
    )
    step_error_time_s: float = real(
        3600.0, 1.0, 1e6, "correlation time of both (first-order Markov)"
    )
    learn_errors: bool = described(
        False,
        "learn scatter, bias and correlation of each RSU's errors, and its share of outliers;"
        " declared ones are a prior",
    )
    isolate_rsus: bool = described(
        True,
        "refuse an RSU that at least two others contradict, and a sensor that is stuck; a first"
        " fix allows for one RSU of three or more that errs grossly",
    )
    manoeuvre_speed_sd_mps: float = real(
        5.0,
        0.0,
        1e3,
        "velocity step that a measurement which fails the gate may reveal; 0: none. A device about"
        " as fast is expected to turn to a side at its speed. Not with an IMU, interacting models"
        " or filter kf",
    )
    inflate_after_epochs: int = count(
        2, "epochs rejected in a row before the velocity opens to its initial sd"
    )
    max_rejected_epochs: int = count(10, "epochs rejected in a row before a new first fix")
    max_gap_s: float = real(30.0, 0.1, 1e5, "a silence longer than this starts a new first fix")
    coast_after_s: float = real(1.0, 0.01, 1e4, "COASTING after this long without a measurement")
    hold_s: float = real(
        0.25, 0.0, 10.0, "longest wait for measurements still missing at an epoch; 0: do not wait"
    )

    odometry_rate_hz: float = real(
        0.0,
        0.0,
        1000.0,
        "strapdown: odometry at multiples of its inverse, too, by the IMU; 0: at epochs only",
    )
    history_s: float = real(
        1.0, 0.0, 60.0, "how late a measurement may come and still be applied in order"
    )
    max_future_s: float = shared.max_future_s()
    fixed_lag_s: float = real(
        0.0, 0.0, 60.0, "smoothed odometry is given out this long after the epoch; 0: none"
    )
    integrity_risk: float = shared.integrity_risk()
    map_frame: str = described("map", "frame of RSUs, poses and estimates (REP-105)")
    odom_frame: str = shared.odom_frame()
    base_frame: str = shared.base_frame()
    datum: str = described(
        "",
        "latitude, longitude [deg] and height [m] on WGS 84 of the origin of map_frame: places"
        " are given as NavSatFix too; empty: unknown",
    )
    network: str = described("", "the network whose RSUs count, one of several; empty: all")
    max_devices: int = count(
        200, "devices tracked at once; one that is silent or has no fix makes room"
    )
    allowed_devices: str = described(
        "", "regular expression that names of devices match as a whole; empty: any name"
    )
    trust: str = choice(
        "first",
        TRUST,
        "whose RsuInfo counts: listed (RSUs of rsus_file, as described there) | first (anybody's;"
        " the first pose of each RSU stands) | any (anybody's newest)",
    )
    max_rate_hz: int = count(
        500,
        "measurements of one device by one RSU in a second of their stamps; more are refused, and"
        " stamps closer together than half of its inverse",
    )
    max_rsu_rate_hz: int = count(
        5000, "measurements by one RSU in a second of their stamps; more are refused"
    )

    def __post_init__(self) -> None:
        check_fields(self)
        self._check_combination()

    def _check_combination(self) -> None:
        try:
            re.compile(self.allowed_devices)
        except re.error as error:
            raise ValueError(
                f"allowed_devices {self.allowed_devices!r} is no regular expression: {error}"
            ) from error
        self.frames.check()
        if self.datum:
            datum_of_text(self.datum)
        if self.require_initial_pose and not self.accept_initialpose:
            raise ValueError("require_initial_pose needs accept_initialpose; set it to true")
        if self.is_strapdown:
            self._check_strapdown()
        if self.interacts and self.fixed_lag_s > 0.0:
            raise ValueError(f"fixed_lag_s must be 0 with motion_model {self.motion_model}")
        if self.steady_accel_density_mps2_sqrthz > 0.0:
            self._check_steady()
        if self.learn_errors and (self.interacts or self.is_strapdown):
            raise ValueError(
                "learn_errors needs a single planar motion model,"
                f" got {self.motion_model!r}; set it to false"
            )
        if self.device_height_sd_m > 0.0 and any(m.heading >= 0 for m in self.motion_models):
            raise ValueError(
                f"motion_model {self.motion_model} needs a known height, got device_height_sd_m"
                f" {self.device_height_sd_m:g}; set it to 0 or take another motion model"
            )
        if self.is_linear and self.calibrates_steps:
            raise ValueError(
                f"filter {self.filter} is linear; leave step_length_factor_sd and"
                " step_heading_offset_sd_rad at 0 or take another filter"
            )

    @property
    def frames(self) -> Frames:
        """Names of the frames."""
        return Frames(self.map_frame, self.odom_frame, self.base_frame)

    @property
    def datum_values(self) -> tuple[float, float, float] | None:
        """Latitude, longitude [deg] and height [m] of the datum; None: unknown."""
        return datum_of_text(self.datum) if self.datum else None

    def _check_steady(self) -> None:
        models = self.motion_models
        driven = all(model.is_driven_by_white_acceleration for model in models)
        if self.process_noise != "continuous" or self.interacts or not driven:
            raise ValueError(
                "steady_accel_density_mps2_sqrthz needs process_noise continuous and one motion"
                f" model moved by white acceleration, got {self.process_noise!r} and"
                f" {self.motion_model!r}; set it to 0"
            )

    def _check_strapdown(self) -> None:
        if not forms.form_of(self.filter).is_extended:
            raise ValueError(
                f"motion_model strapdown has its own error-state filter; leave filter at"
                f" {forms.DEFAULT}, got {self.filter!r}"
            )
        if self.fixed_lag_s > 0.0:
            raise ValueError(
                "motion_model strapdown is smoothed afterwards only (replay --smooth); leave"
                f" fixed_lag_s at 0, got {self.fixed_lag_s}"
            )
        if self.device_height_sd_m > 0.0:
            raise ValueError(
                "motion_model strapdown always estimates the height; set device_height_sd_m to 0,"
                f" got {self.device_height_sd_m:g}"
            )
        if self.calibrates_steps:
            raise ValueError(
                "motion_model strapdown takes no step velocities; leave step_length_factor_sd and"
                " step_heading_offset_sd_rad at 0"
            )

    @property
    def learns_density(self) -> tuple[bool, bool]:
        """Whether the densities of the white acceleration and of the clock's walk are learned on
        the way: of one model, of acceleration if it has one and no IMU, of the clock if a refused
        measurement may have other explanations, a step of the clock among them."""
        models, continuous = self.motion_models, self.process_noise == "continuous"
        if len(models) != 1 or not continuous or self.is_linear:
            return False, False
        has_one = models[0].is_driven_by_white_acceleration and models[0].accel_density is None
        accel = has_one and self.accel_density_mps2_sqrthz == 0.0
        return accel, self.clock_walk_density == 0.0 and self.manoeuvre_sd_mps > 0.0

    @property
    def use_imu(self) -> bool:
        """Whether the device's IMU is an input."""
        return self.is_strapdown or any(model.uses_imu for model in self.motion_models)

    @property
    def is_strapdown(self) -> bool:
        """Whether tracks are in three dimensions and follow the device's IMU."""
        return bool(self.motion_model == STRAPDOWN)

    @property
    def motion_models(self) -> tuple[MotionModel, ...]:
        """Motion models of a planar track: one, or several that interact; none of strapdown."""
        return motion.models_of(self.motion_model)

    @property
    def interacts(self) -> bool:
        """Whether the device changes between several motion models."""
        return len(self.motion_models) > 1

    @property
    def is_linear(self) -> bool:
        """Whether the filter takes positions and velocities only."""
        return forms.form_of(self.filter).update_shared is not None

    @property
    def manoeuvre_sd_mps(self) -> float:
        """Velocity step per axis that a refused measurement may reveal to this estimate; 0: none.

        Interacting models and the gain floor follow manoeuvres by themselves.
        """
        one_gaussian = self.interacts or self.is_strapdown
        if one_gaussian or forms.form_of(self.filter).follows_manoeuvres:
            return 0.0
        return float(getattr(self, self.motion_models[0].manoeuvre_speed))

    @property
    def step_errors(self) -> StepErrors:
        """What is wrong with all steps of a person alike, to be estimated."""
        return StepErrors(
            length_sd=self.step_length_factor_sd,
            heading_sd_rad=self.step_heading_offset_sd_rad,
            tau_s=self.step_error_time_s,
        )

    @property
    def calibrates_steps(self) -> bool:
        """Whether what is wrong with all steps of a person is estimated."""
        return self.step_length_factor_sd > 0.0 or self.step_heading_offset_sd_rad > 0.0

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> TrackerConfig:
        """Config of named values over the defaults; raises ``ValueError`` for a name that does not
        exist."""
        return from_mapping(cls, values, "tracker")
