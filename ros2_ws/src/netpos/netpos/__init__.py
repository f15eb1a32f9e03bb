"""netpos: positioning of vehicles and pedestrians from the network side.

The library behind the ROS 2 nodes; it imports no ROS. SI units and radians, integer nanoseconds
for time.
Frames follow REP-103 and REP-105: ``map`` is east-north-up, a device's ``base_link`` is forward-
left-up.

Rooms
-----
``messages``    value types of the ROS interfaces and their conversion
``world``       maps, routes, motion, frames
``radio``       measurement models, arrays, Cramer-Rao bounds, line of sight, clocks, noise
``inertial``    IMU models, attitude, steps, pedestrian dead reckoning
``filters``     Kalman filters and their compiled kernels
``tracking``    one track per device: initialise, gate, order, reset
``scenario``    one YAML file = one reproducible run
``bags``        MCAP bags: read, write, recover, import
``evaluation``  metrics, consistency, requirement verdicts, reports
``cli``         the ``netpos`` command
"""

from importlib import import_module
from pathlib import Path
from typing import Any

from netpos import kernel_cache

__version__ = "0.1.0"

# What a program that uses netpos imports from here, and nothing else is promised to stay; loaded
# when it is asked for.
_PUBLIC = {
    "ClockState": "netpos.messages.values",
    "Field": "netpos.messages.values",
    "ImuSample": "netpos.messages.values",
    "InitialPose": "netpos.messages.values",
    "Odometry": "netpos.messages.values",
    "Recording": "netpos.bags.recording",
    "RsuInfo": "netpos.messages.values",
    "RsuMeasurement": "netpos.messages.values",
    "Scenario": "netpos.scenario",
    "TrackStatus": "netpos.messages.values",
    "Tracker": "netpos.tracking.tracker",
    "TrackerConfig": "netpos.tracking.config",
    "evaluate": "netpos.evaluation.evaluate",
    "load_scenario": "netpos.scenario",
    "read_bag": "netpos.bags.recording",
    "simulate": "netpos.scenario.offline",
    "track": "netpos.scenario.replay",
    "write_bag": "netpos.bags.recording",
}
# Under other names inside.
_INSIDE = {"evaluate": "assess_bag", "simulate": "simulate_to_bag", "track": "replay_bag"}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"netpos has no {name!r}; it offers {', '.join(_PUBLIC)}")
    return getattr(import_module(_PUBLIC[name]), _INSIDE.get(name, name))


kernel_cache.select(Path(__file__).resolve().parent)
