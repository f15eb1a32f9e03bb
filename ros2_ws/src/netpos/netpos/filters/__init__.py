"""Kalman filters and the models they take, compiled with Numba and cached on disk.

State order (``StateIndex``): x, y [m, map], vx, vy [m/s], clock offset [m], clock drift [m/s],
then one entry per slow sensor bias.
Clock states are times the speed of light, so all are metres and metres per second (fokin2020:
Delta, delta).

``motion``       f, F and Q of the process models
``measurement``  one scalar row per measured quantity: h, H and which components are angles
``ekf``          prediction, gating and the extended Kalman update
"""
