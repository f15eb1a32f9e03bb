"""What a track remembers from epoch to epoch, and what it has applied lately, so that it can go
back when a measurement comes late."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter

from netpos.estimation.noise_scale import NoiseScale
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.estimator import Estimator, Recent
from netpos.tracking.ordering.sequencer import Epoch, Item, channel_and_source
from netpos.tracking.rsus.shares import Shares

_SNAPSHOTS = 2  # states kept per length of the history


@dataclass(slots=True)
class PoseWait:
    """Waiting of one track for an initial pose, which may have been given before the tracker
    came: the stamp of the first epoch without a fix, whether that epoch, or a later
    one, still waits, and whether a pose has come."""

    since_ns: int | None = None
    waits: bool = False
    posed: bool = False

    def awaits(self, config: TrackerConfig, stamp_ns: int, *, tracked: bool) -> bool:
        """Whether a pose is waited for at an epoch; ``tracked``: there was a fix before."""
        if self.since_ns is None:
            self.since_ns = stamp_ns
        waited_s = (stamp_ns - self.since_ns) * 1e-9
        wanted = config.require_initial_pose and not (self.posed or tracked)
        self.waits = wanted and waited_s < config.initial_pose_wait_s
        return self.waits

    def missing(self, config: TrackerConfig, vue_id: str, else_missing: str) -> str:
        """What a first fix lacks: a pose, or ``else_missing``."""
        if not self.waits:
            return else_missing
        return (
            f"waits for a pose on /{vue_id}/initialpose, up to {config.initial_pose_wait_s:g} s "
            "from the first measurement on"
        )


@dataclass(slots=True)
class TrackSnapshot:
    """All of a track that changes with an epoch; unheard of until its first measurement."""

    estimator: Estimator
    shares: Shares
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
        twin.shares = self.shares.copy()
        twin.rsus_scale = self.rsus_scale.copy()
        twin.device_scale = self.device_scale.copy()
        twin.pose_wait = replace(self.pose_wait)
        twin.rejected = self.rejected.copy()
        twin.velocity_ns = self.velocity_ns.copy()
        return twin


_values = attrgetter(*(entry.name for entry in fields(TrackSnapshot)))


class History:
    """The epochs of the last ``length_ns`` and states from which all of them can be applied
    again; nothing for 0."""

    def __init__(self, length_ns: int) -> None:
        self._length_ns = length_ns
        self._epochs: deque[Epoch] = deque()
        self._snapshots: deque[tuple[int, TrackSnapshot]] = deque()
        self._mark_ns = 0

    def clear(self) -> None:
        """Forget all."""
        self._epochs.clear()
        self._snapshots.clear()

    def states(self) -> list[TrackSnapshot]:
        """The states that are kept."""
        return [state for _, state in self._snapshots]

    def mark(self, state: TrackSnapshot) -> None:
        """Keep the ``state`` after the newest epoch: what comes late but is newer than that never
        goes back further."""
        if self._epochs:
            self._mark_ns = self._epochs[-1].stamp_ns + 1
            self._snapshots.append((self._mark_ns, state.copy()))

    def remember(self, epoch: Epoch, state: TrackSnapshot) -> None:
        """Keep the epoch about to be applied and, from time to time, a copy of the ``state``
        before it."""
        if self._length_ns == 0:
            return
        stamp = epoch.stamp_ns
        self._epochs.append(epoch)
        due = not self._snapshots or (
            stamp - self._snapshots[-1][0] >= self._length_ns // _SNAPSHOTS
        )
        if self._snapshots and self._snapshots[-1][0] < self._mark_ns <= stamp:
            self._snapshots.append((self._mark_ns, state.copy()))
        elif due:
            self._snapshots.append((stamp, state.copy()))
        while len(self._snapshots) > 1 and self._snapshots[1][0] <= stamp - self._length_ns:
            self._snapshots.popleft()
        while self._epochs[0].stamp_ns < self._snapshots[0][0]:
            self._epochs.popleft()

    def go_back(self, stamp_ns: int) -> tuple[list[Epoch], TrackSnapshot | None]:
        """The newest state kept from before ``stamp_ns`` and the epochs applied since, in their
        order; both are forgotten here."""
        while len(self._snapshots) > 1 and self._snapshots[-1][0] > stamp_ns:
            self._snapshots.pop()
        if not self._snapshots:
            return [], None
        first_ns, state = self._snapshots.pop()
        epochs: list[Epoch] = []
        while self._epochs and self._epochs[-1].stamp_ns >= first_ns:
            epochs.append(self._epochs.pop())
        return epochs[::-1], state


def merge(epochs: list[Epoch], stamp_ns: int, item: Item) -> Epoch | None:
    """Put a late item into the epoch of its stamp; returns the epoch where that is a new one,
    inserted in its place. A pose that came late stays what it is: the item comes before it."""
    place = 0
    for epoch in epochs:
        if epoch.stamp_ns == stamp_ns and not epoch.is_late_pose():
            epoch.put(channel_and_source(item), item)
            return None
        if epoch.stamp_ns < stamp_ns:
            place += 1
    new = Epoch(stamp_ns)
    new.put(channel_and_source(item), item)
    epochs.insert(place, new)
    return new
