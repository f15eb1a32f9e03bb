"""The third stage: tracks of several networks to one track per device.

Reports are put in stamp order (``sequencer``), all tracks are moved to the stamp of the newest
one, told apart or put together, and those of one device are fused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import cast

import numpy as np

from netpos.estimation.intersection import fuse_pair
from netpos.estimation.level.protection import protection_level
from netpos.estimation.state import POSITION
from netpos.messages.values import Array, NetworkTrack, TrackState, TrackStatus
from netpos.tracking import output
from netpos.tracking.networks.association import Association, Slots, by_name
from netpos.tracking.networks.common_instant import Moved, at_common_instant
from netpos.tracking.networks.config import FusionConfig
from netpos.tracking.networks.validation import network_track_fault
from netpos.tracking.ordering.sequencer import Epoch, Item, Sequencer
from netpos.tracking.report import TrackOutput


class NetworkState(IntEnum):
    """How a network does."""

    SILENT = 0  # not heard yet
    LIVE = 1
    STALE = 2  # left out


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkReport:
    """A network as the fusion sees it: age of its newest track [s], its live tracks, what was
    taken and refused."""

    network: str
    state: NetworkState
    age_s: float
    tracks: int
    accepted: int
    refused: dict[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Device:
    """Tracks that are one device, the most preferred network's first; ``places`` of them among
    all live tracks."""

    vue_id: str
    members: tuple[NetworkTrack, ...]
    places: tuple[int, ...]


@dataclass(slots=True)
class _Entry:
    """The newest track of one source."""

    track: NetworkTrack
    slot: int
    name: str
    accepted: int = 0


@dataclass(slots=True)
class _Network:
    accepted: int = 0
    newest_ns: int = 0
    refused: Counter[str] = field(default_factory=Counter)


class TrackFusion:
    """Turns tracks of networks into one track per device. ``add`` what arrives, then ``process``
    and publish what comes back."""

    def __init__(self, networks: Sequence[str], config: FusionConfig | None = None) -> None:
        """``networks`` in order of preference: a device is called what the first one calls it.

        Raises ``ValueError`` without at least one network, or where one is named twice.
        """
        if not networks or len(set(networks)) < len(networks):
            raise ValueError(f"networks must name each network once, got {list(networks)}")
        self._config = config or FusionConfig()
        self._order = {name: number for number, name in enumerate(networks)}
        self._networks = {name: _Network() for name in networks}
        self._unknown: Counter[str] = Counter()
        self.enabled = True
        self.reset()

    def reset(self) -> None:
        """Forget all tracks; the counts go on."""
        config = self._config
        self._sequencer = Sequencer(
            int(config.hold_s * 1e9),
            future_ns=int(config.max_future_s * 1e9),
            live_ns=int(config.stale_s * 1e9),
        )
        self._association = Association(self._config)
        self._entries: dict[str, _Entry] = {}
        self._yaw: dict[str, float] = {}

    def add(self, track: NetworkTrack) -> str | None:
        """Take a network's track; returns the reason when it is refused (also counted)."""
        reason = self._fault(track)
        if reason is None:
            reason = self._sequence(track)
        network = self._networks.get(track.network)
        if network is None:
            self._unknown["unknown_network"] += 1
        elif reason is not None:
            network.refused[reason] += 1
        else:
            network.accepted += 1
            network.newest_ns = track.stamp_ns
        return reason

    def _sequence(self, track: NetworkTrack) -> str | None:
        if not self._sequencer.newest_ns:
            for name in self._order:  # what has not been heard yet is waited for, too
                self._sequencer.mark(f"{name}/", track.stamp_ns - 1)
        # The sequencer asks an item for its stamp and its source only.
        reason = self._sequencer.add(cast(Item, track))
        if reason is None:
            self._sequencer.mark(f"{track.network}/", track.stamp_ns)
        elif self._sequencer.set_back:
            self.reset()
        return reason

    def _fault(self, track: NetworkTrack) -> str | None:
        if not self.enabled:
            return "disabled"
        if track.network not in self._order:
            return "unknown_network"
        return network_track_fault(track, self._config.map_frame)

    def process(self) -> list[TrackOutput]:
        """Fuse at every instant that is complete, oldest first."""
        return self._apply(self._sequencer.release())

    def flush(self) -> list[TrackOutput]:
        """Fuse all that is pending: the recording has ended, or nothing has come for a while."""
        return self._apply(self._sequencer.flush())

    def rejected(self) -> dict[str, int]:
        """Refused tracks by network and reason."""
        counts = {
            f"{name}: {reason}": n
            for name, network in self._networks.items()
            for reason, n in network.refused.items()
        }
        return counts | dict(self._unknown)

    def network_reports(self) -> list[NetworkReport]:
        """How the networks do, as of the newest track heard."""
        newest = self._sequencer.newest_ns
        return [self._network_report(name, newest) for name in self._order]

    def _network_report(self, name: str, newest_ns: int) -> NetworkReport:
        network = self._networks[name]
        ages_s = [
            (newest_ns - entry.track.stamp_ns) * 1e-9
            for entry in self._entries.values()
            if entry.track.network == name
        ]
        age_s = (newest_ns - network.newest_ns) * 1e-9
        state = NetworkState.SILENT
        if network.accepted:
            state = NetworkState.STALE if age_s > self._config.stale_s else NetworkState.LIVE
        return NetworkReport(
            network=name,
            state=state,
            age_s=age_s if network.accepted else -1.0,
            tracks=sum(age <= self._config.stale_s for age in ages_s),
            accepted=network.accepted,
            refused=dict(network.refused),
        )

    def _apply(self, epochs: list[Epoch]) -> list[TrackOutput]:
        """All devices of which a track of an epoch speaks, fused."""
        outputs = []
        for epoch in epochs:
            reports = [cast(NetworkTrack, item) for item in epoch.sorted()]
            moved, devices = self.put_together(epoch.stamp_ns, reports)
            spoken = {report.source for report in reports}
            for device in devices:
                if any(track.source in spoken for track in device.members):
                    mean, cov = self._fuse(moved, device.places)
                    outputs.append(self._output(epoch.stamp_ns, device, mean, cov))
        return outputs

    def put_together(
        self, stamp_ns: int, reports: Sequence[NetworkTrack]
    ) -> tuple[Moved, list[Device]]:
        """All live tracks at ``stamp_ns`` and which of them are the same device; a track that
        might be one of another network's, but not clearly, is left out."""
        for report in reports:
            self._take(report)
        self._forget(stamp_ns)
        live = [
            entry
            for entry in self._entries.values()
            if stamp_ns - entry.track.stamp_ns <= self._config.stale_s * 1e9
        ]
        live.sort(key=lambda entry: (self._order[entry.track.network], entry.track.vue_id))
        tracks = [entry.track for entry in live]
        moved = at_common_instant(tracks, stamp_ns, self._config.jerk_density)
        slots = np.array([entry.slot for entry in live])
        groups, unclear = self._grouped(stamp_ns, live, slots, moved)
        place = {slot: index for index, slot in enumerate(slots.tolist())}
        devices = []
        taken: set[str] = set()
        for group in groups:
            places = tuple(place[slot] for slot in group)
            name = self._name([live[i] for i in places], taken)
            taken.add(name)
            if len(group) > 1 or group[0] not in unclear:
                members = tuple(tracks[i] for i in places)
                devices.append(Device(vue_id=name, members=members, places=places))
        return moved, devices

    def _take(self, report: NetworkTrack) -> None:
        entry = self._entries.get(report.source)
        if entry is None:
            slot = self._association.scores.take_slot()
            entry = self._entries[report.source] = _Entry(report, slot, self._own_name(report))
        elif entry.track.segment != report.segment:
            self._association.forget(entry.slot)
        entry.track = report
        entry.accepted += 1

    def _forget(self, stamp_ns: int) -> None:
        """Drop what has been silent for long."""
        limit_ns = stamp_ns - int(self._config.forget_s * 1e9)
        for source in [s for s, e in self._entries.items() if e.track.stamp_ns < limit_ns]:
            self._association.end(self._entries.pop(source).slot)

    def _grouped(
        self, stamp_ns: int, live: list[_Entry], slots: Slots, moved: Moved
    ) -> tuple[list[list[int]], set[int]]:
        network = np.array([self._order[entry.track.network] for entry in live])
        if self._config.association == "names":
            return by_name(slots, [entry.track.vue_id for entry in live]), set()
        self._association.scores.look(stamp_ns, slots, moved, network)
        return self._association.groups(slots, network)

    def _name(self, members: list[_Entry], taken: set[str]) -> str:
        """What a device is called: as its most preferred member was last called. A member that
        has left a device takes its own name again."""
        name = members[0].name
        if name in taken:
            name = self._own_name(members[0].track)
        for member in members:
            member.name = name
        return name

    def _own_name(self, track: NetworkTrack) -> str:
        """What a network's track is called alone: names of other networks than the first may mean
        other devices."""
        if self._config.association == "names" or self._order[track.network] == 0:
            return track.vue_id
        return f"{track.network}_{track.vue_id}"

    def _fuse(self, moved: Moved, indices: Sequence[int]) -> tuple[Array, Array]:
        first, *others = indices
        mean, cov, own = moved.mean[first], moved.cov[first], moved.own_cov[first]
        for i in others:
            pair = fuse_pair(cov, own, moved.cov[i], moved.own_cov[i], self._config.method)
            mean = pair.gain_a @ mean + pair.gain_b @ moved.mean[i]
            cov, own = pair.cov, pair.own
        return mean, cov

    def _output(self, stamp_ns: int, device: Device, mean: Array, cov: Array) -> TrackOutput:
        last_yaw = self._yaw.get(device.vue_id, 0.0)
        yaw, yaw_var = output.heading(mean, cov, last_yaw)
        self._yaw[device.vue_id] = yaw
        height_m = device.members[0].height_m
        odometry = output.odometry(stamp_ns, device.vue_id, mean, cov, height_m, yaw, yaw_var)
        sources = [member.source for member in device.members]
        status = TrackStatus(
            stamp_ns=stamp_ns,
            vue_id=device.vue_id,
            state=TrackState.TRACKING,
            used=len(sources),
            accepted=sum(self._entries[source].accepted for source in sources),
            rejected=self.rejected(),
            sources=tuple(sources),
            position_sd_m=output.largest_sd(cov),
            protection_level_m=protection_level(
                cov[POSITION, POSITION], self._config.integrity_risk
            ),
        )
        return TrackOutput(odometry, None, status)
