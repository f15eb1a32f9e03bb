"""Each reason of refusal, just inside and just outside."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from netpos.messages.fields import stamp_ns
from netpos.messages.values import (
    Field,
    GroundSpeed,
    ImuSample,
    InitialPose,
    NetworkTrack,
    RsuInfo,
    RsuMeasurement,
    Velocity,
)
from netpos.tracking.door.validation import (
    explanation,
    imu_fault,
    measurement_fault,
    pose_fault,
    rsu_fault,
    speed_fault,
    velocity_fault,
)
from netpos.tracking.networks.validation import network_track_fault

NAN, INF = math.nan, math.inf
C = 299_792_458.0
SCALARS = [
    (Field.AZIMUTH, "azimuth_rad", "azimuth_var", 1.0),
    (Field.ELEVATION, "elevation_rad", "elevation_var", 1.0),
    (Field.TOA, "toa_s", "toa_var", C),
    (Field.RANGE, "range_m", "range_var", 1.0),
]
GOOD = RsuMeasurement(
    stamp_ns=1,
    rsu_id="a",
    vue_id="v",
    fields=Field(63),
    azimuth_var=1.0,
    elevation_var=1.0,
    toa_var=1e-16,
    range_var=1.0,
    phase_difference_var=1.0,
    position_cov=np.diag([1.0, 1.0, 0.0]),
)
INFO = RsuInfo(rsu_id="a", position=np.zeros(3))


def test_sound_values_pass() -> None:
    assert measurement_fault(GOOD) is None
    assert (
        velocity_fault(Velocity(stamp_ns=1, vue_id="v", velocity=np.ones(2), cov=np.eye(2)))
        is None
    )
    assert speed_fault(GroundSpeed(stamp_ns=1, vue_id="v", speed_mps=-1.0, speed_var=1e-9)) is None
    pose = InitialPose(stamp_ns=0, vue_id="v", position=np.ones(3), cov=np.eye(3))
    assert pose_fault(pose) is None
    assert rsu_fault(INFO) is None


@pytest.mark.parametrize("stamp_ns", [0, -1])
def test_zero_stamp(stamp_ns: int) -> None:
    assert measurement_fault(replace(GOOD, stamp_ns=stamp_ns)) == "zero_stamp"
    v = Velocity(stamp_ns=stamp_ns, vue_id="v", velocity=np.ones(2), cov=np.eye(2))
    assert velocity_fault(v) == "zero_stamp"
    s = GroundSpeed(stamp_ns=stamp_ns, vue_id="v", speed_mps=1.0, speed_var=1.0)
    assert speed_fault(s) == "zero_stamp"


@pytest.mark.parametrize("vue_id", ["", "a b", "a/b", "1st"])
def test_vue_id(vue_id: str) -> None:
    assert measurement_fault(replace(GOOD, vue_id=vue_id)) == "vue_id"


def test_fields() -> None:
    assert measurement_fault(replace(GOOD, fields=Field(0))) == "no_fields"
    assert measurement_fault(replace(GOOD, fields=Field(128))) == "unknown_fields"
    assert measurement_fault(replace(GOOD, fields=GOOD.fields | Field(128))) == "unknown_fields"
    assert measurement_fault(replace(GOOD, fields=Field(2**31))) == "unknown_fields"


def test_phase() -> None:
    phase = replace(GOOD, fields=Field.PHASE, phase_difference_var=0.01)
    assert measurement_fault(phase) is None
    for value in (math.pi, -math.pi):
        assert measurement_fault(replace(phase, phase_difference_rad=value)) is None
        beyond = replace(phase, phase_difference_rad=value * (1 + 1e-15))
        assert measurement_fault(beyond) == "phase_not_wrapped"
        unused = replace(beyond, fields=Field.RANGE)
        assert measurement_fault(unused) is None
    both = replace(phase, fields=Field.PHASE | Field.RANGE)
    assert measurement_fault(both) is None
    assert measurement_fault(replace(both, phase_difference_var=0.0)) == "variance"
    assert measurement_fault(replace(both, phase_difference_rad=NAN)) == "not_finite"
    assert measurement_fault(replace(both, phase_difference_var=0.99e-12)) == "variance"
    assert measurement_fault(replace(both, phase_difference_var=1.01e-12)) is None


@pytest.mark.parametrize(("flag", "name", "var_name", "scale"), SCALARS)
def test_scalars(flag: Field, name: str, var_name: str, scale: float) -> None:
    one = replace(GOOD, fields=flag)
    assert measurement_fault(one) is None
    for bad in (NAN, INF, -INF, 1e9, -1e9):
        assert measurement_fault(replace(one, **{name: bad})) == "not_finite"
    assert measurement_fault(replace(one, **{name: 0.999e9})) is None
    for bad in (NAN, INF, -INF):
        assert measurement_fault(replace(one, **{var_name: bad})) == "not_finite"
    too_small, too_large = 0.99e-12 / scale**2, 1.01e12 / scale**2
    for bad in (0.0, -1.0, -1e-300, 1e-300, 1e300, too_small, too_large):
        assert measurement_fault(replace(one, **{var_name: bad})) == "variance"
    for good in (1.01e-12 / scale**2, 0.99e12 / scale**2):
        assert measurement_fault(replace(one, **{var_name: good})) is None
    # what is not named does not matter
    others = replace(GOOD, fields=GOOD.fields & ~flag, **{name: NAN, var_name: -1.0})
    assert measurement_fault(others) is None


def test_negative_range() -> None:
    assert measurement_fault(replace(GOOD, range_m=-1e-9)) == "negative_range"
    assert measurement_fault(replace(GOOD, range_m=0.0)) is None
    unnamed = replace(GOOD, range_m=-1.0, fields=Field.TOA)
    assert measurement_fault(unnamed) is None


GAUSSIANS = [
    ([NAN, 0.0], np.eye(2), "not_finite"),
    ([0.0, INF], np.eye(2), "not_finite"),
    ([1e9, 0.0], np.eye(2), "not_finite"),
    ([0.0, -1e9], np.eye(2), "not_finite"),
    ([0.9e9, 0.0], np.eye(2), None),
    ([0.0, 0.0], np.full((2, 2), NAN), "not_finite"),
    ([0.0, 0.0], np.diag([1.0, INF]), "not_finite"),
    ([0.0, 0.0], np.diag([1.0, 0.0]), "variance"),
    ([0.0, 0.0], np.diag([-1.0, 1.0]), "variance"),
    ([0.0, 0.0], np.zeros((2, 2)), "variance"),
    ([0.0, 0.0], np.array([[1.0, 0.5], [0.4, 1.0]]), "variance"),
    ([0.0, 0.0], np.array([[1.0, 0.5], [0.5 * (1 + 0.9e-6), 1.0]]), None),
    ([0.0, 0.0], np.array([[1.0, 0.5], [0.5 * (1 + 1.1e-6), 1.0]]), "variance"),
    ([0.0, 0.0], np.array([[1.0, 1.01], [1.01, 1.0]]), "variance"),
    ([0.0, 0.0], np.array([[1.0, 0.99], [0.99, 1.0]]), None),
    ([0.0, 0.0], np.array([[1.0, 1e-9], [0.0, 1.0]]), "variance"),
    # singular, but its smallest eigenvalue may round to something positive
    ([0.0, 0.0], np.array([[1.0, 1.0], [1.0, 1.0]]), "variance"),
    ([0.0, 0.0], np.array([[0.01, 0.03], [0.03, 0.09]]), "variance"),
    ([0.0, 0.0], np.diag([1e6, 0.9e-6]), "variance"),
    ([0.0, 0.0], np.diag([1e6, 1.1e-6]), None),
    ([0.0, 0.0], np.diag([1e-12, 0.99e-12]), "variance"),
    ([0.0, 0.0], np.diag([1e-12, 1.01e-12]), None),
    ([0.0, 0.0], np.diag([1e12, 1.01e12]), "variance"),
    ([0.0, 0.0], np.diag([0.99e12, 0.9]), "variance"),
    ([0.0, 0.0], np.diag([0.99e12, 1.1]), None),
    # finite, but their products are not
    ([0.0, 0.0], np.diag([1e300, 1e300]), "variance"),
    ([0.0, 0.0], np.full((2, 2), 1e300), "variance"),
    ([0.0, 0.0], np.array([[1.0, 1e300], [1e300, 1.0]]), "variance"),
    ([0.0, 0.0], np.array([[1.0, -1.7e308], [-1.7e308, 1.7e308]]), "variance"),
]


@pytest.mark.parametrize(("value", "cov", "reason"), GAUSSIANS)
def test_gaussians(value: list[float], cov: np.ndarray, reason: str | None) -> None:
    """The same rule for fixes, velocities and initial poses."""
    xyz, cov3 = np.array([*value, NAN]), np.full((3, 3), NAN)  # height does not matter
    cov3[:2, :2] = cov
    fix = replace(GOOD, fields=Field.POSITION, position=xyz, position_cov=cov3)
    assert measurement_fault(fix) == reason
    assert measurement_fault(replace(fix, fields=Field.TOA)) is None
    v = Velocity(stamp_ns=1, vue_id="v", velocity=np.array(value), cov=cov)
    assert velocity_fault(v) == reason
    assert pose_fault(InitialPose(stamp_ns=1, vue_id="v", position=xyz, cov=cov3)) == reason


@pytest.mark.parametrize(("frame", "fault"), [("", None), ("map", None), ("odom", "frame")])
def test_a_place_is_one_in_the_map(frame: str, fault: str | None) -> None:
    pose = InitialPose(stamp_ns=1, vue_id="v", frame_id=frame, position=np.ones(3), cov=np.eye(3))
    assert pose_fault(pose) == fault
    assert measurement_fault(replace(GOOD, frame_id=frame)) == fault
    bearing = replace(GOOD, frame_id=frame, fields=Field.AZIMUTH)
    assert measurement_fault(bearing) is None  # has no place in it
    wanted = fault and "pose of a is in 'odom'; give it in 'map'"
    assert rsu_fault(replace(INFO, frame_id=frame)) == wanted


@pytest.mark.parametrize("frame", ["", "odom", "vue_1/pdr_start"])
def test_velocity_frame(frame: str) -> None:
    v = Velocity(stamp_ns=1, vue_id="v", frame_id=frame, velocity=np.ones(2), cov=np.eye(2))
    assert velocity_fault(v) == "frame"


def test_speed() -> None:
    good = GroundSpeed(stamp_ns=1, vue_id="v", speed_mps=1.0, speed_var=1.0)
    assert speed_fault(replace(good, speed_mps=NAN)) == "not_finite"
    assert speed_fault(replace(good, speed_mps=INF)) == "not_finite"
    assert speed_fault(replace(good, speed_var=NAN)) == "not_finite"
    assert speed_fault(replace(good, speed_var=INF)) == "not_finite"
    assert speed_fault(replace(good, speed_var=0.0)) == "variance"
    assert speed_fault(replace(good, speed_var=-1.0)) == "variance"
    assert speed_fault(replace(good, speed_var=1e-300)) == "variance"
    assert speed_fault(replace(good, speed_mps=1e9)) == "not_finite"
    assert speed_fault(replace(good, speed_mps=-1e9)) == "not_finite"
    assert speed_fault(replace(good, speed_mps=0.99e9)) is None


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"rsu_id": ""}, "rsu_id is empty"),
        ({"position": np.array([0.0, NAN, 0.0])}, "pose of a is not finite"),
        ({"quaternion": np.array([0.0, 0.0, INF, 1.0])}, "pose of a is not finite"),
        ({"quaternion": np.zeros(4)}, "orientation of a is not a unit quaternion"),
        (
            {"quaternion": np.array([0.0, 0.0, 0.0, 1.0011])},
            "orientation of a is not a unit quaternion",
        ),
        (
            {"quaternion": np.array([0.0, 0.0, 0.0, 0.9989])},
            "orientation of a is not a unit quaternion",
        ),
        ({"quaternion": np.array([0.0, 0.0, 0.0, 1.0009])}, None),
        ({"azimuth_bias_sd_rad": -0.1}, "bias sd of a must be finite and >= 0"),
        ({"elevation_bias_sd_rad": NAN}, "bias sd of a must be finite and >= 0"),
        ({"range_bias_sd_m": INF}, "bias sd of a must be finite and >= 0"),
        ({"common_range_bias_sd_m": NAN}, "bias sd of a must be finite and >= 0"),
        ({"common_range_bias_sd_m": -1.0}, "bias sd of a must be finite and >= 0"),
        (
            {"azimuth_bias_sd_rad": 0.1},
            "bias_correlation_time of a must be > 0 s where it has a bias",
        ),
        (
            {"range_bias_sd_m": 0.1, "bias_correlation_time_s": -1.0},
            "bias_correlation_time of a must be > 0 s where it has a bias",
        ),
        (
            {"range_bias_sd_m": 0.1, "bias_correlation_time_s": NAN},
            "bias_correlation_time of a must be > 0 s where it has a bias",
        ),
        ({"range_bias_sd_m": 0.1, "bias_correlation_time_s": 1e-3}, None),
        (
            {"common_range_bias_sd_m": 0.1},
            "common_bias_correlation_time of a must be > 0 s where it has a bias",
        ),
        (
            {"common_range_bias_sd_m": 0.1, "common_bias_correlation_time_s": NAN},
            "common_bias_correlation_time of a must be > 0 s where it has a bias",
        ),
        ({"common_range_bias_sd_m": 0.1, "common_bias_correlation_time_s": 5.0}, None),
        (
            {"noise_correlation_time_s": -1.0},
            "noise_correlation_time of a must be finite and >= 0 s",
        ),
        (
            {"noise_correlation_time_s": NAN},
            "noise_correlation_time of a must be finite and >= 0 s",
        ),
        (
            {"noise_correlation_time_s": INF},
            "noise_correlation_time of a must be finite and >= 0 s",
        ),
        ({"noise_correlation_time_s": 0.5}, None),
        ({"baseline_m": 0.2, "wavelength_m": 0.05}, None),
        ({"baseline_m": 0.025, "wavelength_m": 0.05}, None),
        (
            {"baseline_m": 0.2},
            "a has a baseline of 0.2 m but no wavelength; give the wavelength of its channel [m]",
        ),
        (
            {"baseline_m": 0.0249, "wavelength_m": 0.05},
            "baseline of a must be at least half its wavelength of 0.05 m, got 0.0249 m",
        ),
        (
            {"wavelength_m": 0.05},
            "baseline of a must be at least half its wavelength of 0.05 m, got 0 m",
        ),
        (
            {"baseline_m": 2.51, "wavelength_m": 0.05},
            "baseline of a must be at most 50 wavelengths of 0.05 m, got 2.51 m",
        ),
        (
            {
                "baseline_m": 0.2,
                "wavelength_m": 0.05,
                "quaternion": np.array([math.sin(0.03), 0.0, 0.0, math.cos(0.03)]),
            },
            "the antennas of a must be level, one is 6 % of the baseline above the other; "
            "correct its orientation",
        ),
        ({"baseline_m": NAN}, "baseline and wavelength of a must be finite and >= 0 m"),
        ({"wavelength_m": -1.0}, "baseline and wavelength of a must be finite and >= 0 m"),
    ],
)
def test_rsu(change: dict[str, Any], text: str | None) -> None:
    fault = rsu_fault(replace(INFO, **change))
    if text is None:
        assert fault is None
    else:
        assert fault == text


@pytest.mark.parametrize(
    ("changes", "reason", "sentence"),
    [
        ({"range_m": -1.5}, "negative_range", "range_m is -1.5 m; send a distance >= 0 m, or no"),
        (
            {"phase_difference_rad": 4.0},
            "phase_not_wrapped",
            "phase_difference_rad is 4 rad; wrap",
        ),
        ({"azimuth_rad": NAN}, "not_finite", "azimuth_rad is nan rad; leave out"),
        ({"elevation_var": INF}, "not_finite", "elevation_var is inf rad^2; send one from 1e-12"),
        (
            {"toa_var": 0.0},
            "variance",
            "toa_var is 0 s^2; send one from 1.11265e-29 to 1.11265e-05",
        ),
        ({"lever_arm": (NAN, 0.0, 0.0)}, "lever_arm", ""),
    ],
)
def test_a_refusal_names_value_and_remedy(
    changes: dict[str, Any], reason: str, sentence: str
) -> None:
    bad = replace(GOOD, **changes)
    assert measurement_fault(bad) == reason
    assert explanation(bad, reason).startswith(sentence)
    assert bool(explanation(bad, reason)) == bool(sentence)


def test_a_scalar_that_is_not_sent_is_not_explained() -> None:
    bad = replace(GOOD, fields=Field.AZIMUTH, range_m=-1.0, toa_var=0.0, azimuth_var=-1.0)
    assert explanation(bad, "negative_range") == ""
    assert explanation(bad, "variance").startswith("azimuth_var is -1 rad^2")


HUGE = replace(INFO, position=np.array([1e308, 0.0, 0.0]))
ODD_TIME = replace(INFO, range_bias_sd_m=0.1, bias_correlation_time_s=1e-300)


@pytest.mark.parametrize(
    ("info", "text"),
    [
        (HUGE, "pose.position.x of a is 1e+308 m; send one from -1e+09 to 1e+09"),
        (replace(INFO, position=np.array([0.0, -1.01e9, 0.0])), "pose.position.y of a is -1.01e+"),
        (replace(INFO, position=np.array([0.0, 0.0, 1.01e9])), "pose.position.z of a is 1.01e+09"),
        (replace(INFO, position=np.array([-1e9, 1e9, 1e9])), None),
        (ODD_TIME, "bias_correlation_time of a is 1e-300 s; send one from 1e-06 to 1e+09, or 0"),
        (replace(ODD_TIME, bias_correlation_time_s=0.99e-6), "bias_correlation_time of a is 9.9e"),
        (replace(ODD_TIME, bias_correlation_time_s=1e-6), None),
        (replace(ODD_TIME, bias_correlation_time_s=1e9), None),
        (replace(ODD_TIME, bias_correlation_time_s=INF), "bias_correlation_time of a is inf s"),
        (
            replace(INFO, common_range_bias_sd_m=1.0, common_bias_correlation_time_s=1e-300),
            "common_bias_correlation_time of a is 1e-300 s",
        ),
        (replace(INFO, noise_correlation_time_s=1e-300), "noise_correlation_time of a is 1e-300"),
        (replace(ODD_TIME, bias_correlation_time_s=1.0, range_bias_sd_m=1e-300), "range_bias_sd"),
        (replace(ODD_TIME, bias_correlation_time_s=1.0, range_bias_sd_m=1.1e6), "range_bias_sd"),
        (
            replace(INFO, azimuth_bias_sd_rad=5e-324, bias_correlation_time_s=1.0),
            "azimuth_bias_sd",
        ),
        (replace(INFO, baseline_m=1e-300, wavelength_m=1e-300), "wavelength of a is 1e-300 m"),
    ],
)
def test_numbers_of_an_rsu_that_no_track_can_hold(info: RsuInfo, text: str | None) -> None:
    fault = rsu_fault(info)
    assert (fault is None) if text is None else (fault or "").startswith(text), fault


def malformed(nanosec: int = 4 * 10**9) -> int:
    return stamp_ns(SimpleNamespace(sec=5, nanosec=nanosec))


def test_a_stamp_that_is_none_is_refused_of_everything() -> None:
    bad = malformed()
    m = replace(GOOD, stamp_ns=bad)
    assert measurement_fault(m) == "bad_stamp"
    assert explanation(m, "bad_stamp") == (
        "header.stamp.nanosec is 4000000000; send one below 1000000000"
    )
    v = Velocity(stamp_ns=bad, vue_id="v", velocity=np.ones(2), cov=np.eye(2))
    assert velocity_fault(v) == "bad_stamp"
    s = GroundSpeed(stamp_ns=bad, vue_id="v", speed_mps=1.0, speed_var=1.0)
    assert speed_fault(s) == "bad_stamp"
    p = InitialPose(stamp_ns=bad, vue_id="v", position=np.ones(3), cov=np.eye(3))
    assert pose_fault(p) == "bad_stamp"
    zeros = np.zeros(3)
    i = ImuSample(stamp_ns=bad, vue_id="v", angular_velocity=zeros, specific_force=zeros)
    assert imu_fault(i) == "bad_stamp"
    assert rsu_fault(replace(INFO, stamp_ns=bad)) == (
        "RsuInfo of a: header.stamp.nanosec is 4000000000; send one below 1000000000"
    )
    track = NetworkTrack(stamp_ns=bad, network="n", vue_id="v", mean=np.zeros(6), cov=np.eye(6))
    assert network_track_fault(track) == "bad_stamp"
    assert measurement_fault(replace(GOOD, stamp_ns=malformed(10**9))) == "bad_stamp"
    assert measurement_fault(replace(GOOD, stamp_ns=malformed(10**9 - 1))) is None
