"""One track per device: order the measurements, initialise, gate, update, report.

``config``      every parameter of the tracker
``door``        what is refused, and why
``ordering``    stamp order and epochs
``first_fix``   from whatever has been measured
``estimators``  what a track estimates with
``rsus``        the RSUs and what is learned of their errors
``health``      which of them are to be believed
``smoothing``   every epoch given what came after it
``track``       one device; ``tracker`` all of them; ``output``, ``report``: what they say
``networks``    several networks, one track: a tracker each, their tracks fused
"""

from netpos.tracking.config import TrackerConfig
from netpos.tracking.report import TrackOutput
from netpos.tracking.tracker import Tracker

__all__ = ["TrackOutput", "Tracker", "TrackerConfig"]
