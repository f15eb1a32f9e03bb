"""One track per device: order the measurements, initialise, gate, update, report.

``config``      every parameter of the tracker
``validation``  what is refused at the door, and why
``sequencer``   stamp order and epochs
``initialise``  the first fix from whatever has been measured
``track``       one device
``output``      state to odometry, clock state and status
``tracker``     all devices
``networks``    several networks, one track: a tracker each, their tracks fused
"""

from netpos.tracking.config import TrackerConfig
from netpos.tracking.report import TrackOutput
from netpos.tracking.tracker import Tracker

__all__ = ["TrackOutput", "Tracker", "TrackerConfig"]
