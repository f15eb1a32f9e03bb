"""5G stations and strapdown inertial navigation (deng2022), simulated and with a real IMU.

``paper`` is the reproduction as a whole; the other modules are its parts.
"""
