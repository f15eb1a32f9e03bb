"""All stages in one process: a tracker per network, then the fusion of their tracks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

from netpos.messages.values import ImuSample, Odometry, RsuInfo
from netpos.tracking.config import TrackerConfig
from netpos.tracking.networks.config import FusionConfig
from netpos.tracking.networks.tertiary import TrackFusion
from netpos.tracking.ordering.sequencer import Item
from netpos.tracking.report import TrackOutput
from netpos.tracking.tracker import Tracker


class Chain:
    """Takes what a ``Tracker`` takes and gives what all trackers and the fusion give."""

    def __init__(
        self,
        networks: Sequence[str],
        config: TrackerConfig,
        fusion: FusionConfig,
        rsus: Sequence[RsuInfo] = (),
    ) -> None:
        self.config = config
        self._trackers = [Tracker(replace(config, network=name), rsus) for name in networks]
        self.fusion = TrackFusion(networks, fusion)

    def add_rsu(self, info: RsuInfo) -> None:
        """Make an RSU known to all. Raises ``ValueError`` for a description that is refused."""
        for tracker in self._trackers:
            tracker.add_rsu(info)

    def refused_rsus(self) -> dict[str, str]:
        """RSUs whose newest description is refused, and why."""
        return {k: v for tracker in self._trackers for k, v in tracker.refused_rsus().items()}

    def add(self, item: Item | ImuSample) -> None:
        """Give an item to every tracker: each takes what is for its network."""
        for tracker in self._trackers:
            tracker.add(item)

    def process(self) -> list[TrackOutput]:
        """All that is complete: of the networks, then of the fusion."""
        return list(self._through(tracker.process() for tracker in self._trackers))

    def flush(self) -> list[TrackOutput]:
        """All that is pending."""
        outputs = list(self._through(tracker.flush() for tracker in self._trackers))
        return outputs + self.fusion.flush()

    def _through(self, results: Iterator[list[TrackOutput]]) -> Iterator[TrackOutput]:
        for outputs in results:
            for output in outputs:
                yield output
                if output.track is not None:
                    self.fusion.add(output.track)
                    yield from self.fusion.process()

    def rejected(self) -> dict[str, Counter[str]]:
        """Refused and rejected measurements by device and reason, tracks by network."""
        total: dict[str, Counter[str]] = {}
        for tracker in self._trackers:
            for vue, counts in tracker.rejected().items():
                total.setdefault(vue, Counter()).update(counts)
        if self.fusion.rejected():
            total["fusion"] = Counter(self.fusion.rejected())
        return total

    def smoothed(self) -> dict[str, list[Odometry]]:
        """None: what several networks have fused is not smoothed."""
        return {}
