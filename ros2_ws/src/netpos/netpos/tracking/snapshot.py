"""What a track remembers from epoch to epoch."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter

from netpos.estimation.noise_scale import NoiseScale
from netpos.tracking.estimator import Estimator, Recent
from netpos.tracking.nlos_rate import NlosRate
from netpos.tracking.pose_wait import PoseWait


@dataclass(slots=True)
class TrackSnapshot:
    """All of a track that changes with an epoch; unheard of until its first measurement."""

    estimator: Estimator
    nlos_rate: NlosRate
    segment: int = 0
    recent: Recent = ()
    """The newest epochs that fitted: an initial pose is weighed with them."""
    rsus_scale: NoiseScale = field(default_factory=NoiseScale)
    """Of epochs with a measurement of an RSU."""
    device_scale: NoiseScale = field(default_factory=NoiseScale)
    """Of those without one: steps that agree say nothing of ranges."""
    has_clock: bool = False
    pose_wait: PoseWait = field(default_factory=PoseWait)
    rejected_in_row: int = 0
    undetected_m: float = 0.0
    last_accepted_ns: int = 0
    velocity_ns: dict[str, int] = field(default_factory=dict)
    accepted: int = 0
    rejected: defaultdict[str, int] = field(default_factory=lambda: defaultdict(int))

    def copy(self) -> TrackSnapshot:
        """An independent copy, for a track to go back to."""
        twin = TrackSnapshot(*_values(self))
        twin.estimator = self.estimator.copy()
        twin.nlos_rate = self.nlos_rate.copy()
        twin.rsus_scale = self.rsus_scale.copy()
        twin.device_scale = self.device_scale.copy()
        twin.pose_wait = replace(self.pose_wait)
        twin.rejected = self.rejected.copy()
        twin.velocity_ns = self.velocity_ns.copy()
        return twin


_values = attrgetter(*(entry.name for entry in fields(TrackSnapshot)))
