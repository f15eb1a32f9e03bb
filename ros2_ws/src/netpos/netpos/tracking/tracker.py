"""All devices: refuse what is unsound, order the rest, keep one track per device."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from netpos.messages.values import GroundSpeed, InitialPose, RsuInfo, RsuMeasurement, Velocity
from netpos.tracking import validation
from netpos.tracking.config import TrackerConfig
from netpos.tracking.rsus import Rsu
from netpos.tracking.sequencer import Epoch, Item, Sequencer
from netpos.tracking.track import Track, TrackOutput


class Tracker:
    """Turns measurements into tracks. ``add`` what arrives, then ``process`` and publish what
    comes back."""

    def __init__(self, config: TrackerConfig | None = None) -> None:
        self._config = config or TrackerConfig()
        self._rsus: dict[str, Rsu] = {}
        self._tracks: dict[str, Track] = {}
        self._sequencers: dict[str, Sequencer] = {}
        self.enabled = True

    @property
    def config(self) -> TrackerConfig:
        """The effective parameters."""
        return self._config

    @property
    def rsu_count(self) -> int:
        """How many RSUs are known."""
        return len(self._rsus)

    def add_rsu(self, info: RsuInfo) -> None:
        """Make an RSU known or replace it. Raises ``ValueError`` for an unsound description."""
        fault = validation.rsu_fault(info)
        if fault is not None:
            raise ValueError(f"RSU refused: {fault}")
        self._rsus[info.rsu_id] = Rsu.of(info)

    def add(self, item: Item) -> str | None:
        """Take a measurement; returns the reason when it is refused (also counted in the track's
        status)."""
        reason = self._fault(item)
        if reason is None:
            reason = self._sequencer(item.vue_id).add(item)
        if reason is not None:
            self._track(item.vue_id).rejected[reason] += 1
        return reason

    def process(self) -> list[TrackOutput]:
        """Apply every epoch that is complete, oldest first, device by device."""
        return self._apply(Sequencer.release)

    def flush(self) -> list[TrackOutput]:
        """Apply all that is pending: the recording has ended, or nothing has come for a while."""
        return self._apply(Sequencer.flush)

    def reset(self) -> None:
        """Forget all tracks and what is pending; RSUs stay known. For a clock that jumped back."""
        self._sequencers.clear()
        for track in self._tracks.values():
            track.reset()

    def rejected(self) -> dict[str, Counter[str]]:
        """Refused and rejected measurements by device and reason."""
        return {vue: track.rejected for vue, track in self._tracks.items()}

    def _apply(self, take: Callable[[Sequencer], list[Epoch]]) -> list[TrackOutput]:
        return [
            self._track(vue).step(epoch)
            for vue in sorted(self._sequencers)
            for epoch in take(self._sequencers[vue])
        ]

    def _fault(self, item: Item) -> str | None:
        if not self.enabled:
            return "disabled"
        match item:
            case RsuMeasurement():
                fault = validation.measurement_fault(item)
                if fault is None and item.rsu_id not in self._rsus:
                    return "unknown_rsu"
                return fault
            case Velocity():
                return validation.velocity_fault(item)
            case GroundSpeed():
                return validation.speed_fault(item)
            case InitialPose():
                return validation.pose_fault(item)

    def _sequencer(self, vue_id: str) -> Sequencer:
        if vue_id not in self._sequencers:
            self._sequencers[vue_id] = Sequencer(
                int(self._config.hold_s * 1e9), self._config.require_initial_pose
            )
        return self._sequencers[vue_id]

    def _track(self, vue_id: str) -> Track:
        if vue_id not in self._tracks:
            self._tracks[vue_id] = Track(vue_id, self._config, self._rsus)
        return self._tracks[vue_id]
