"""netpos: positioning of vehicles and pedestrians from the network side.

The library below the ROS 2 nodes; it imports no ROS. SI units and radians, integer nanoseconds
for time. Frames follow REP-103 and REP-105: ``map`` is east-north-up, a device's ``base_link`` is
forward-left-up.

What a program imports
----------------------
``Tracker``, ``TrackerConfig``      RSUs and measurements in, tracks out
``RsuInfo``, ``RsuMeasurement``     what goes in
``Scenario``                        one YAML file = one reproducible run: load it, simulate it
``read_bag``, ``write_bag``         a recording, which can be tracked again
``evaluate``                        errors, consistency and verdicts of a tracked recording

The values of the other messages, such as ``ImuSample`` and ``Odometry``, are in
``netpos.messages``. Nothing else is promised to stay.

Rooms
-----
``messages``      values of the ROS interfaces and their conversion
``common``        parameters, least squares, files, memory of the compiler
``world``         maps, routes, motion, frames
``radio``         measurement models, arrays, Cramer-Rao bounds, line of sight, clocks, noise
``inertial``      IMU models, attitude, steps, pedestrian dead reckoning
``estimation``    what one state is and how it changes: sensors, motion, filter forms, kernels
``tracking``      one track per device: order, first fix, gate, health, networks
``bags``          MCAP bags: read, write, recover, import
``scenario``      one YAML file = one reproducible run; replay
``live``          what viewers show while a graph runs
``evaluation``    metrics, consistency, requirement verdicts, reports
``reproduction``  a folder for each paper
``bench``         speed as ratios
``cli``           the ``netpos`` command
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from netpos import kernel_cache

__version__ = "0.1.0"
__all__ = [
    "RsuInfo",
    "RsuMeasurement",
    "Scenario",
    "Tracker",
    "TrackerConfig",
    "evaluate",
    "read_bag",
    "write_bag",
]

# Module and name of each; loaded when it is asked for, as together they take a second.
_HOME = {
    "RsuInfo": ("netpos.messages.values", "RsuInfo"),
    "RsuMeasurement": ("netpos.messages.values", "RsuMeasurement"),
    "Scenario": ("netpos.scenario", "Scenario"),
    "Tracker": ("netpos.tracking.tracker", "Tracker"),
    "TrackerConfig": ("netpos.tracking.config", "TrackerConfig"),
    "evaluate": ("netpos.evaluation.evaluate", "assess_bag"),
    "read_bag": ("netpos.scenario.recording", "read_bag"),
    "write_bag": ("netpos.scenario.recording", "write_bag"),
}

if TYPE_CHECKING:  # for editors and type checkers, which then also refuse other names
    from netpos.evaluation.evaluate import assess_bag as evaluate
    from netpos.messages.values import RsuInfo, RsuMeasurement
    from netpos.scenario import Scenario
    from netpos.scenario.recording import read_bag, write_bag
    from netpos.tracking.config import TrackerConfig
    from netpos.tracking.tracker import Tracker
else:

    def __getattr__(name: str) -> Any:
        if name in _HOME:
            module, inside = _HOME[name]
            return getattr(import_module(module), inside)
        text = f"netpos has no {name!r}; it offers {', '.join(__all__)}"
        # Of an AttributeError, `from netpos import x` would drop the text.
        importing = sys._getframe(1).f_globals.get("__name__") == "importlib._bootstrap"
        if importing and not name.startswith("_") and find_spec(f"netpos.{name}") is None:
            raise ImportError(text)
        raise AttributeError(text)

    def __dir__() -> list[str]:
        return [*__all__, "__version__"]


kernel_cache.select(Path(__file__).resolve().parent)
