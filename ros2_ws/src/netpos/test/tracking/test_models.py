"""From parameters to the arrays of the kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from netpos.estimation.engine import GATE_SIZE, FilterOptions
from netpos.estimation.forms.table import FORMS
from netpos.estimation.motion import Model, Parameter, ProcessNoise, own_index
from netpos.estimation.state import POSITION
from netpos.estimation.update.conditioning import RobustOptions
from netpos.tracking.config import ROBUST, TrackerConfig
from netpos.tracking.estimators.models import (
    augmented,
    gate_thresholds,
    initial_extra_sd,
    motions_of,
    options_of,
    pose_state,
)
from scipy.constants import speed_of_light
from scipy.stats import chi2


def test_every_filter_has_its_place_in_the_engine() -> None:
    assert [form.name for form in FORMS] == ["ekf", "iekf", "ukf", "srukf", "kf"]
    for place, form in enumerate(FORMS):
        options = options_of(TrackerConfig(filter=form.name))
        assert options.filter == place
        assert options.iterations == (8 if form.name == "iekf" else 1)
        assert options.of_form.size == (3 if form.name == "kf" else 0)


def test_learning_leaves_the_update_as_robust_says() -> None:
    def robust(**parameters: Any) -> tuple[str, float]:
        options = options_of(TrackerConfig(learn_errors=True, **parameters)).robust
        return ROBUST[options.kind], options.parameter

    assert robust()[0] == "none"
    assert robust(robust="huber", robust_parameter=2.0) == ("huber", 2.0)


def test_options_hold_what_the_parameters_say() -> None:
    config = TrackerConfig(
        filter="srukf",
        device_height_m=1.5,
        inflate_after_epochs=3,
        max_rejected_epochs=14,
        initial_speed_sd_mps=6.5,
        manoeuvre_speed_sd_mps=7.5,
        robust="student_t",
        robust_parameter=5.5,
        nlos_probability=0.1,
        nlos_mean_excess_m=33.0,
        gate_probability=0.99,
        integrity_risk=1e-5,
        coast_after_s=0.7,
    )
    options = options_of(config)
    expected = FilterOptions(
        filter=3,
        iterations=1,
        height_m=1.5,
        inflate_after=3,
        lost_after=14,
        initial_speed_sd=6.5,
        manoeuvre_speed_sd=7.5,
        integrity_risk=1e-5,
        robust=RobustOptions(ROBUST.index("student_t"), 5.5, 0.1, 33.0),
        models=1,
        first_slow_error=2**31 - 1,
        sector_slip=1e-6,
        learns_density=(True, True),
        of_form=options.of_form,
        gate_nis=options.gate_nis,
    )
    assert options == expected
    np.testing.assert_array_equal(options.gate_nis, gate_thresholds(0.99))
    assert len(options.gate_nis) == GATE_SIZE


def test_options_hold_what_the_form_has_of_its_own() -> None:
    config = TrackerConfig(
        filter="kf", position_gain_min=0.2, velocity_gain_min=0.3, accel_gain_min=0.4
    )
    assert options_of(config).of_form.tolist() == [0.2, 0.3, 0.4]


def test_options_have_one_signature_whatever_the_user_writes() -> None:
    """Whole numbers for real ones would compile every kernel once more."""
    whole = TrackerConfig(device_height_m=1, manoeuvre_speed_sd_mps=2, nlos_mean_excess_m=30)
    kinds = [[type(value) for value in o] for o in map(options_of, (whole, TrackerConfig()))]
    assert kinds[0] == kinds[1]
    assert [type(v) for v in options_of(whole).robust] == [int, float, float, float]


@pytest.mark.parametrize(
    ("parameters", "states"),
    [
        ({"filter": "ekf"}, 6),
        ({"filter": "iekf", "motion_model": "constant_acceleration"}, 8),
        ({"filter": "ekf", "device_height_sd_m": 2.0}, 7),
    ],
)
def test_extended_forms_follow_slow_errors(parameters: dict[str, Any], states: int) -> None:
    assert options_of(TrackerConfig(**parameters)).first_slow_error == states


@pytest.mark.parametrize("form", ["ukf", "srukf", "kf"])
def test_other_forms_do_not_follow_slow_errors(form: str) -> None:
    assert options_of(TrackerConfig(filter=form)).first_slow_error > 1_000_000


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.9999])
def test_thresholds_are_chi_square_quantiles(probability: float) -> None:
    t = gate_thresholds(probability)
    assert t[0] == 0.0
    for dof in range(1, GATE_SIZE):
        assert chi2.cdf(t[dof], dof) == pytest.approx(probability, abs=1e-12)


@pytest.mark.parametrize(
    ("change", "accel"),
    [
        ({}, 0.7),
        ({"process_noise": "white_acceleration"}, 0.6),
        ({"motion_model": "inertial"}, 0.3),
        ({"motion_model": "inertial", "process_noise": "white_acceleration"}, 0.3),
    ],
)
def test_motion_takes_its_own_acceleration(change: dict[str, Any], accel: float) -> None:
    config = TrackerConfig(
        accel_density_mps2_sqrthz=0.7,
        accel_sd_mps2=0.6,
        inertial_accel_density_mps2_sqrthz=0.3,
        **change,
    )
    ((motion),) = motions_of(config)
    assert motion[Parameter.ACCEL] == accel


def test_motion_is_in_metres() -> None:
    config = TrackerConfig(
        process_noise="werner",
        clock_white_density=1e-9,
        clock_walk_density=2e-7,
        drift_step_sd=3e-6,
        velocity_step_sd_mps=0.4,
        gyro_noise_density=0.008,
    )
    ((motion),) = motions_of(config)
    c = speed_of_light
    expected = {
        Parameter.MODEL: Model.CONSTANT_VELOCITY,
        Parameter.NOISE: ProcessNoise.WERNER,
        Parameter.EXTRAS: 0,
        Parameter.VELOCITY_STEP: 0.4,
        Parameter.OFFSET_DENSITY: c * 1e-9,
        Parameter.DRIFT_DENSITY: c * 2e-7,
        Parameter.DRIFT_STEP: c * 3e-6,
        Parameter.IDLE: 0.0,
        Parameter.GYRO: 0.008,
        Parameter.YAW_INCREMENT: 0.0,
        Parameter.SPEED_INCREMENT: 0.0,
    }
    for entry, value in expected.items():
        assert motion[entry] == pytest.approx(value, rel=1e-12), entry.name


@pytest.mark.parametrize(
    ("name", "own"),
    [
        ("constant_velocity", {}),
        ("constant_turn", {"turn_rate": 0.5}),
        ("constant_acceleration", {"jerk": 0.6}),
        ("inertial", {"gyro_bias": 0.0009, "accel_bias": 0.011}),
        ("rigid_body", {"turn_rate": 0.5}),
    ],
)
def test_motion_has_what_its_model_has_of_its_own(name: str, own: dict[str, float]) -> None:
    config = TrackerConfig(
        motion_model=name,
        turn_rate_density=0.5,
        jerk_density=0.6,
        gyro_bias_walk=0.0009,
        accel_bias_walk=0.011,
    )
    ((motion),) = motions_of(config)
    found = {entry: motion[own_index(Model[name.upper()], entry)] for entry in own}
    assert found == own
    assert not motion[int(Parameter.OWN) + len(own) :].any()


def test_interacting_models_keep_the_states_of_others_alive() -> None:
    config = TrackerConfig(
        motion_model="interacting", turn_rate_density=0.5, rest_speed_sd_mps=0.07
    )
    stop, straight, turn = motions_of(config)
    assert stop[Parameter.IDLE] == straight[Parameter.IDLE] == 0.5
    assert stop[own_index(Model.STATIONARY, "rest_speed")] == 0.07
    assert turn[own_index(Model.CONSTANT_TURN, "turn_rate")] == 0.5
    assert [m[Parameter.STATES] for m in (stop, straight, turn)] == [0, 0, 1]


@pytest.mark.parametrize(
    ("name", "models", "sd"),
    [
        ("constant_velocity", [Model.CONSTANT_VELOCITY], []),
        ("constant_turn", [Model.CONSTANT_TURN], [0.25]),
        ("constant_acceleration", [Model.CONSTANT_ACCELERATION], [1.5, 1.5]),
        (
            "interacting",
            [Model.STATIONARY, Model.CONSTANT_VELOCITY, Model.CONSTANT_TURN],
            [0.25],
        ),
        ("inertial", [Model.INERTIAL], [0.02, 0.3]),
    ],
)
def test_models_and_their_own_states(name: str, models: list[Model], sd: list[float]) -> None:
    config = TrackerConfig(
        motion_model=name,
        turn_rate_density=0.25,
        accel_state_sd_mps2=1.5,
        gyro_bias_sd_radps=0.02,
        accel_bias_sd_mps2=0.3,
    )
    motions = motions_of(config)
    assert motions[:, Parameter.MODEL].tolist() == models
    assert set(motions[:, Parameter.EXTRAS]) == {len(sd)}  # all share one state
    assert initial_extra_sd(config).tolist() == sd


def test_pose_state_is_that_of_the_paper() -> None:
    """fokin2020:eq.32, 33."""
    config = TrackerConfig(initial_speed_sd_mps=4.0, clock_offset_sd_s=1e-5, clock_drift_mean=1e-6)
    cov = np.array([[4.0, 1.0], [1.0, 9.0]])
    mean, P = pose_state(config, np.array([3.0, -4.0]), cov)
    c = speed_of_light
    np.testing.assert_allclose(mean, [3.0, -4.0, 0.0, 0.0, 0.0, 1e-6 * c])
    np.testing.assert_array_equal(P[POSITION, POSITION], cov)
    np.testing.assert_allclose(np.diag(P)[2:], [16.0, 16.0, (1e-5 * c) ** 2, (30e-6 * c) ** 2])
    assert np.count_nonzero(P) == 8


def test_growing_appends_independent_states() -> None:
    A = np.random.default_rng(0).normal(size=(7, 7))
    mean, cov = np.arange(7.0), A @ A.T
    same = augmented(mean, cov, np.array([0.5]))
    assert same[0] is mean
    x, P = augmented(mean, cov, np.array([0.5, 2.0, 3.0]))
    np.testing.assert_array_equal(x, [*range(7), 0.0, 0.0])
    np.testing.assert_array_equal(P[:7, :7], cov)
    np.testing.assert_array_equal(P[7:, 7:], np.diag([4.0, 9.0]))
    assert not P[:7, 7:].any()
    assert not P[7:, :7].any()


@pytest.mark.parametrize(
    ("values", "sd"),
    [
        ({"manoeuvre_speed_sd_mps": 3.0}, 3.0),
        ({"manoeuvre_speed_sd_mps": 3.0, "motion_model": "rigid_body"}, 3.0),
        ({"manoeuvre_speed_sd_mps": 3.0, "motion_model": "inertial"}, 0.0),
        ({"inertial_manoeuvre_speed_sd_mps": 0.3, "motion_model": "inertial"}, 0.3),
        ({"inertial_manoeuvre_speed_sd_mps": 0.3, "manoeuvre_speed_sd_mps": 0.0}, 0.0),
        ({"manoeuvre_speed_sd_mps": 3.0, "motion_model": "interacting"}, 0.0),
    ],
)
def test_a_manoeuvre_is_allowed_where_nothing_else_shows_it(
    values: dict[str, Any], sd: float
) -> None:
    assert options_of(TrackerConfig(**values)).manoeuvre_speed_sd == sd
