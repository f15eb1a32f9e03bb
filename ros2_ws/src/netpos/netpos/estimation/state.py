"""Which entry of a state is what: the planar state of the filters, and the navigation and error
states of the strapdown track.

Clock states are times the speed of light, so all are metres and metres per second (fokin2020:
Delta, delta). Biases of RSUs and of step velocities follow the entries named here, in the order in
which they were first heard.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class X(IntEnum):
    """Entries of a planar state. From ``N_CORE`` on come the states of the motion model, which
    share their entries, then the biases."""

    PX = 0  # position [m, map]
    PY = 1
    VX = 2  # velocity [m/s, map]
    VY = 3
    CLOCK = 4  # offset [m]
    DRIFT = 5  # [m/s]
    TURN_RATE = 6  # CONSTANT_TURN [rad/s]
    AX = 6
    AY = 7
    GYRO_BIAS = 6
    ACCEL_BIAS = 7
    YAW = 6
    YAW_RATE = 7


N_CORE = 6
"""Number of states that every planar track has."""
POSITION, VELOCITY, CLOCK_DRIFT = slice(0, 2), slice(2, 4), slice(4, 6)


class HeightState(NamedTuple):
    """The block ``height`` of a planar state, behind the states of the motion model: one entry,
    the height of the device over the nominal one [m], a first-order Gauss-Markov process."""

    entry: int = 0
    """Its index; 0: the height is known, and the state has none."""
    nominal_m: float = 0.0
    """Height in map where the entry is 0."""


KNOWN_HEIGHT = HeightState()


class Nav(IntEnum):
    """Entries of a navigation state: those of ``inertial.strapdown``, then the device's clock."""

    PX = 0  # position [m, map]
    PY = 1
    PZ = 2
    VX = 3  # velocity [m/s, map]
    VY = 4
    VZ = 5
    QX = 6  # base_link to map
    QY = 7
    QZ = 8
    QW = 9
    ACCEL_BIAS = 10  # x of three [m/s^2]
    GYRO_BIAS = 13  # x of three [rad/s]
    CLOCK = 16  # offset [m]
    DRIFT = 17  # [m/s]


NAV_POSITION, NAV_VELOCITY, NAV_QUATERNION = slice(0, 3), slice(3, 6), slice(6, 10)
NAV_ACCEL_BIAS, NAV_GYRO_BIAS, NAV_CLOCK_DRIFT = slice(10, 13), slice(13, 16), slice(16, 18)


class Err(IntEnum):
    """Entries of the error state (true minus estimate) of a navigation state: the attitude has
    three, so that an entry behind it is one less than that of ``Nav``."""

    PX = 0  # position [m, map]
    PY = 1
    PZ = 2
    VX = 3  # velocity [m/s, map]
    VY = 4
    VZ = 5
    ROLL = 6  # rotation vector in map axes [rad]: about x,
    PITCH = 7  # y
    YAW = 8  # and z
    ACCEL_BIAS = 9  # x of three [m/s^2]
    GYRO_BIAS = 12  # x of three [rad/s]
    CLOCK = 15  # offset [m]
    DRIFT = 16  # [m/s]


ERR_BIASES = 17
"""Index of the first bias in an error state with a clock."""
ERR_POSITION, ERR_VELOCITY, ERR_ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
ERR_ACCEL_BIAS, ERR_GYRO_BIAS, ERR_CLOCK_DRIFT = slice(9, 12), slice(12, 15), slice(15, 17)
