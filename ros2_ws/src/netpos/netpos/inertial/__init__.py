"""Inertial sensors and pedestrians: simulated walks, attitude, steps, dead reckoning, recordings.

Modules
-------
``gait``      how the waist of a walking person moves, in closed form
``imu``       what an inertial sensor and a magnetometer make of a motion
``strapdown`` attitude, velocity and position from increments in space
``alignment`` coarse alignment of strapdown navigation
``attitude``  gyro + accelerometer (+ magnetometer) -> orientation
``magnetic_calibration``  iron worn with a magnetometer
``steps``     streaming step detector, stillness
``length``    step length models and the scale of a person
``pdr``       ``PedestrianDeadReckoning``: IMU samples in, steps and step velocity out; its
              ``pdr_config``, ``pdr_output``, ``pdr_values`` (what is published), and ``watch``
              (what is wrong with the input)
``loaders``   public gait, phone and attitude recordings -> SI arrays

Frames
------
map   ENU, x east, y north, z up. Without a magnetometer the frame is still level, but its
      x axis is the horizontal forward axis of the body at alignment ("relative").
body  FLU, x forward, y left, z up, rigidly attached to the IMU.
Quaternions are (w, x, y, z), body -> map. Heading is counter-clockwise from map x (east),
in [-pi, pi); it is a direction, not a compass azimuth.

Units
-----
Stamps are int nanoseconds; m, m/s, m/s^2, rad, rad/s, tesla. An accelerometer measures specific
force: (0, 0, +9.81) at rest and level. ``*_sd`` is a standard deviation, ``covariance`` holds
variances.
"""
