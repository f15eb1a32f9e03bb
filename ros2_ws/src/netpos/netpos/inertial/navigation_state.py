"""Order of the navigation state and of its error state (``strapdown``)."""

from __future__ import annotations

POSITION, VELOCITY, QUATERNION, ACCEL_BIAS, GYRO_BIAS = 0, 3, 6, 10, 13  # in NAV
NAV = 16
ATTITUDE_ERR, ACCEL_BIAS_ERR, GYRO_BIAS_ERR = 6, 9, 12  # in ERR, whose begin is that of NAV
ERR = 15
