"""The vector ``motion`` that the kernels take: what all models have in common, then what one model
has of its own."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from netpos.common.parameters import real

SPEED_OF_LIGHT_MPS = 299_792_458.0
NO_BIAS = np.zeros((2, 0))


class ProcessNoise(IntEnum):
    """How Q of motion and clock follows from the elapsed time."""

    CONTINUOUS = 0  # continuous white acceleration and white + random-walk frequency noise
    WERNER = 1  # per step diag(0, 0, sv^2, sv^2, 0, seta^2), fokin2020:eq.4
    WHITE_ACCELERATION = 2  # per step G G' ss^2, fokin2020:eq.36; clock as WERNER


class Parameter(IntEnum):
    """Entries of ``motion``. Those from ``OWN`` on belong to its model, which names them."""

    MODEL = 0
    NOISE = 1
    STATES = 2  # number of states that the model itself has
    EXTRAS = 3  # number of states that all models of its set have
    ACCEL = 4  # continuous: density [m/s^2/sqrt(Hz)]; WHITE_ACCELERATION: sd [m/s^2]
    VELOCITY_STEP = 5  # WERNER: sd per step [m/s]
    OFFSET_DENSITY = 6  # CONTINUOUS: clock white frequency noise [m/sqrt(s)]
    DRIFT_DENSITY = 7  # CONTINUOUS: clock random-walk frequency noise [m/s/sqrt(s)]
    DRIFT_STEP = 8  # WERNER, WHITE_ACCELERATION: sd per step [m/s]
    IDLE = 9  # walk of the states that only other models of the set have [1/sqrt(s)]
    YAW_INCREMENT = 10  # input: integrated yaw rate of the IMU over the step [rad]
    SPEED_INCREMENT = 11  # input: its integrated forward acceleration [m/s]
    GYRO = 12  # input: its angle random walk [rad/sqrt(s)]
    VELOCITY_STEP_SD = 13  # [m/s] of a velocity step that the filter allowed for; 0: none
    VELOCITY_STEP_AGE = 14  # how long ago it happened [s]
    VELOCITY_STEP_POSITION_SD = 15  # [m] of the position it led to: its time is not known
    OWN = 16


OWN = int(Parameter.OWN)
"""Index of the first entry that a model has of its own."""

TURN_RATE = {
    "turn_rate_density": real(
        0.3,
        1e-9,
        1e3,
        "constant_turn, rigid_body, interacting: walk of the turn rate [rad/s/sqrt(s)]",
    )
}
"""The tracker parameter of every model that turns."""
