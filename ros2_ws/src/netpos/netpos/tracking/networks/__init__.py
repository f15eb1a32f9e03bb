"""Several networks, one track: the stages of dvornikov2017, Fig. 2.

primary    a network's raw fixes: ``POSITION`` measurements of its RSUs
secondary  the network's own tracks: a ``Tracker`` told its ``network``; ``shares`` splits their
           covariance into own and shared noise
tertiary   ``common_instant`` moves the tracks of all networks to one time, ``association`` tells
           which are the same device, ``tertiary`` fuses them
``config``     parameters of the third stage
``validation`` what it refuses, and why
``chain``      all stages in one process, without ROS
"""
