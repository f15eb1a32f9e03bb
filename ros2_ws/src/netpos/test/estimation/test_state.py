"""The names of the entries of a state against what the models do with them."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation import motion
from netpos.estimation.motion import NO_BIAS, Model, extra_states, motion_parameters
from netpos.estimation.state import (
    CLOCK_DRIFT,
    ERR_ACCEL_BIAS,
    ERR_ATTITUDE,
    ERR_BIASES,
    ERR_CLOCK_DRIFT,
    ERR_GYRO_BIAS,
    ERR_POSITION,
    ERR_VELOCITY,
    N_CORE,
    NAV_ACCEL_BIAS,
    NAV_CLOCK_DRIFT,
    NAV_GYRO_BIAS,
    NAV_POSITION,
    NAV_QUATERNION,
    NAV_VELOCITY,
    POSITION,
    VELOCITY,
    Err,
    Nav,
    X,
)
from netpos.inertial import strapdown


def test_core_states_come_first_and_blocks_cover_them() -> None:
    core = [X.PX, X.PY, X.VX, X.VY, X.CLOCK, X.DRIFT]
    assert core == list(range(N_CORE))
    entries = np.arange(N_CORE)
    blocks = [entries[block].tolist() for block in (POSITION, VELOCITY, CLOCK_DRIFT)]
    assert blocks == [core[:2], core[2:4], core[4:]]


@pytest.mark.parametrize(
    ("model", "states"),
    [
        (Model.CONSTANT_TURN, [X.TURN_RATE]),
        (Model.CONSTANT_ACCELERATION, [X.AX, X.AY]),
        (Model.INERTIAL, [X.GYRO_BIAS, X.ACCEL_BIAS]),
        (Model.RIGID_BODY, [X.YAW, X.YAW_RATE]),
    ],
)
def test_states_of_a_motion_model_follow_the_core(model: Model, states: list[X]) -> None:
    assert states == list(range(N_CORE, N_CORE + extra_states(model)))


def test_rates_move_what_they_are_the_rates_of() -> None:
    mean = np.zeros(N_CORE + 2)
    mean[X.VX], mean[X.VY], mean[X.DRIFT], mean[X.YAW_RATE] = 2.0, -3.0, 5.0, 7.0
    before = mean.copy()
    motion.propagate(mean, 0.5, motion_parameters(Model.RIGID_BODY), NO_BIAS)
    moved = {X.PX: 1.0, X.PY: -1.5, X.CLOCK: 2.5, X.YAW: 3.5}
    for entry, step in moved.items():
        before[entry] += step
    np.testing.assert_allclose(mean, before, rtol=1e-15)


def test_spatial_entries_are_those_of_the_strapdown_system() -> None:
    """A quaternion has one entry more than the error of the attitude."""
    nav = np.arange(strapdown.NAV + 2)
    assert nav[strapdown.POSITION] == Nav.PX
    assert nav[strapdown.VELOCITY] == Nav.VX
    assert nav[NAV_POSITION].tolist() == [Nav.PX, Nav.PY, Nav.PZ]
    assert nav[NAV_VELOCITY].tolist() == [Nav.VX, Nav.VY, Nav.VZ]
    assert nav[NAV_QUATERNION].tolist() == [Nav.QX, Nav.QY, Nav.QZ, Nav.QW]
    assert nav[NAV_QUATERNION][0] == strapdown.QUATERNION
    assert nav[NAV_ACCEL_BIAS][0] == strapdown.ACCEL_BIAS == Nav.ACCEL_BIAS
    assert nav[NAV_GYRO_BIAS][0] == strapdown.GYRO_BIAS == Nav.GYRO_BIAS
    assert nav[NAV_CLOCK_DRIFT].tolist() == [Nav.CLOCK, Nav.DRIFT]
    assert strapdown.NAV == Nav.CLOCK

    err = np.arange(strapdown.ERR + 2)
    assert err[ERR_POSITION].tolist() == [Err.PX, Err.PY, Err.PZ]
    assert err[ERR_VELOCITY].tolist() == [Err.VX, Err.VY, Err.VZ]
    assert err[ERR_ATTITUDE].tolist() == [Err.ROLL, Err.PITCH, Err.YAW]
    assert err[ERR_ATTITUDE][0] == strapdown.ATTITUDE_ERR
    assert err[ERR_ACCEL_BIAS][0] == strapdown.ACCEL_BIAS_ERR == Err.ACCEL_BIAS
    assert err[ERR_GYRO_BIAS][0] == strapdown.GYRO_BIAS_ERR == Err.GYRO_BIAS
    assert err[ERR_CLOCK_DRIFT].tolist() == [Err.CLOCK, Err.DRIFT]
    assert strapdown.ERR == Err.CLOCK
    assert ERR_BIASES == Err.DRIFT + 1
