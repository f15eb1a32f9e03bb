"""What a track remembers from epoch to epoch."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter

import numpy as np

from netpos.estimation.protection import NisWindow
from netpos.messages.values import Array
from netpos.tracking.adaptive_process_noise import AdaptiveProcessNoise
from netpos.tracking.config import TrackerConfig
from netpos.tracking.epoch_rows import EpochRows
from netpos.tracking.estimates import Estimate, KalmanEstimate
from netpos.tracking.initialise import Initialiser
from netpos.tracking.networks.secondary import OwnNoise
from netpos.tracking.nlos_rate import NlosRate
from netpos.tracking.phase_start import PhaseStart
from netpos.tracking.pose_wait import PoseWait
from netpos.tracking.rsus import BiasStates


@dataclass(slots=True)
class TrackSnapshot:
    """All of a track that changes with an epoch; unheard of until its first measurement."""

    biases: BiasStates
    initialiser: Initialiser
    nlos_rate: NlosRate
    phase_start: PhaseStart
    process_noise: AdaptiveProcessNoise
    segment: int = 0
    estimate: Estimate | None = None
    own: OwnNoise | None = None
    bias: Array = field(default_factory=lambda: np.zeros((2, 0)))
    pose: tuple[int, Array, Array] | None = None
    """Stamp, mean and covariance of an initial pose that waits for its heading."""
    recent: tuple[tuple[int, EpochRows], ...] = ()
    """Stamps and rows of the newest epochs that fitted: an initial pose is weighed with them."""
    nis_window: NisWindow = field(default_factory=NisWindow)
    yaw: float = 0.0
    has_clock: bool = False
    pose_wait: PoseWait = field(default_factory=PoseWait)
    rejected_in_row: int = 0
    undetected_m: float = 0.0
    last_accepted_ns: int = 0
    velocity_ns: dict[str, int] = field(default_factory=dict)
    accepted: int = 0
    rejected: defaultdict[str, int] = field(default_factory=lambda: defaultdict(int))

    def set_config(self, config: TrackerConfig) -> None:
        """Go on with other live parameters; a first fix under way keeps those it began with."""
        self.phase_start.config = config
        self.process_noise.set_config(config)
        if isinstance(self.estimate, KalmanEstimate):
            self.estimate.set_config(config)

    def copy(self) -> TrackSnapshot:
        """An independent copy, for a track to go back to."""
        twin = TrackSnapshot(*_values(self))
        twin.biases = self.biases.copy()
        twin.nlos_rate = self.nlos_rate.copy()
        if self.estimate is None:
            twin.initialiser = self.initialiser.copy()
            twin.phase_start = self.phase_start.copy()
            twin.pose_wait = replace(self.pose_wait)
        else:
            twin.estimate = self.estimate.copy()
        twin.nis_window = self.nis_window.copy()
        twin.rejected = self.rejected.copy()
        twin.velocity_ns = self.velocity_ns.copy()
        twin.process_noise = self.process_noise.copy()
        return twin


_values = attrgetter(*(entry.name for entry in fields(TrackSnapshot)))
