"""All devices: refuse what is unsound, order the rest, keep one track per device."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from netpos.messages.topics import is_vue_id
from netpos.messages.values import (
    Field,
    GroundSpeed,
    ImuSample,
    InitialPose,
    Odometry,
    RsuErrors,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    TrackStatus,
    Velocity,
)
from netpos.tracking.config import TrackerConfig
from netpos.tracking.door import validation
from netpos.tracking.door.admission import Admission
from netpos.tracking.door.rate_limit import RATE, RateLimit
from netpos.tracking.door.refusals import Refusals
from netpos.tracking.door.repeats import REPEATED, Repeats
from netpos.tracking.door.voices import CONFLICT, Voices
from netpos.tracking.health import diagnosis
from netpos.tracking.health.diagnosis import Finding
from netpos.tracking.health.health import HealthConfig, RsuHealth, RsuReport
from netpos.tracking.live_parameters import check_change
from netpos.tracking.ordering.clocks import Clocks, Stranger
from netpos.tracking.ordering.sequencer import IMU, Epoch, Item, Sequencer
from netpos.tracking.report import TrackOutput
from netpos.tracking.rsus.register import Register
from netpos.tracking.rsus.rsu import REFERENCED
from netpos.tracking.rsus.shared_errors import SharedErrors
from netpos.tracking.smoothing.planar import check_smoothable
from netpos.tracking.track import Track, warm_up_strapdown

_PHASE = int(Field.PHASE)  # a plain integer: arithmetic of flags costs ten times as much
_OLD_POSE_NS = 1_000_000_000
_TELL_EVERY = 10  # refused items of a device without an estimate


class Tracker:
    """Turns measurements into tracks. ``add`` what arrives, then ``process`` and publish what
    comes back."""

    def __init__(
        self,
        config: TrackerConfig | None = None,
        rsus: Iterable[RsuInfo] = (),
        *,
        keep_posteriors: bool = False,
    ) -> None:
        """``rsus``: the network's own list, known from the start (``trust``).
        ``keep_posteriors``: for ``smoothed``, the memory of a whole recording.

        Raises ``ValueError`` where they are wanted of a tracker that cannot be smoothed, for an
        unsound list, or with ``trust: listed`` without one.
        """
        self._config = config or TrackerConfig()
        self._keep_posteriors = keep_posteriors
        if keep_posteriors:
            check_smoothable(self._config)
        if self._config.is_strapdown:
            warm_up_strapdown(self._config)
        self._tracks: dict[str, Track] = {}
        self._sequencers: dict[str, Sequencer] = {}
        self._clocks: dict[str, Clocks] = {}  # of devices whose time was set back
        settle_s = max(2.0, self._config.history_s + 1.0)
        self._shared = SharedErrors(settle_s) if self._config.learn_errors else None
        self._touched: set[str] = set()
        self._untold: dict[str, int] = {}  # stamps of refusals to be told
        self._errors: dict[str, RsuErrors] = {}  # the newest by RSU
        self.refusals = Refusals(self._config.map_frame)
        """What was refused at the door, by device and RSU."""
        self._register = Register(self._config.trust, rsus, self.refusals, self._config.map_frame)
        self._rsus = self._register.known
        self._health = RsuHealth(
            HealthConfig(settle_s=settle_s), self._rsus, probation=self._config.trust == "first"
        )
        self.enabled = True
        self._admission = Admission(*_admission_limits(self._config))
        self._left: list[str] = []
        self._rate = RateLimit(self._config.max_rate_hz, self._config.max_rsu_rate_hz)
        self._repeats = Repeats()
        self._voices = Voices()

    @property
    def config(self) -> TrackerConfig:
        """The effective parameters."""
        return self._config

    def check_config(self, config: TrackerConfig) -> None:
        """Raises ``ValueError`` where ``set_config`` would, and changes nothing."""
        check_change(self._config, config)

    def set_config(self, config: TrackerConfig) -> None:
        """Go on with other parameters, all of them from the next epoch on.

        Raises ``ValueError`` for one that may not change while a tracker runs
        (``live_parameters``); then nothing changes.
        """
        self.check_config(config)
        self._config = config
        self._admission.set_limits(*_admission_limits(config))
        self._rate.set_limits(config.max_rate_hz, config.max_rsu_rate_hz)
        for track in self._tracks.values():
            track.set_config(config)

    @property
    def rsu_count(self) -> int:
        """How many RSUs are known."""
        return len(self._rsus)

    def add_rsu(self, info: RsuInfo) -> None:
        """Make an RSU known, or describe it anew as far as ``trust`` lets it. Raises
        ``ValueError`` for a description that is unsound or not trusted."""
        self._register.add(info)

    def refused_rsus(self) -> dict[str, str]:
        """RSUs whose newest description is refused, and why."""
        return self.refusals.descriptions()

    def accept_rsus(self) -> list[str]:
        """Let the poses hold that known RSUs were refused (``trust: first``); their names."""
        return self._register.accept()

    def add(self, item: Item | ImuSample) -> str | None:
        """Take a measurement; returns the reason when it is refused (also counted in the track's
        status)."""
        if isinstance(item, RsuMeasurement):
            if self._config.network and not self.concerns(item):
                return None
            source = item.rsu_id, item.vue_id, item.stamp_ns
            shut = self._shut(*source)
            if shut is not None:
                return shut
            self._rate.count(*source)
        elif isinstance(item, ImuSample):
            return self._add_imu(item)
        reason = self._fault(item)
        shut = self._admits(item, reason is None)
        if shut is not None:
            return shut
        reason = reason or self._contradicted(item) or self._repeated(item)
        if reason is None:
            sequencer = self._sequencers.get(item.vue_id) or self._sequencer(item.vue_id)
            sequencer.silenced = self._voices.silenced(item.vue_id, item.stamp_ns)
            reason = sequencer.add(item)
            for refused, why in sequencer.take_refused():
                self._refuse(refused, why)
            if reason is None and self.refusals.any:
                self.refusals.take(item)
            if reason is None and isinstance(item, RsuMeasurement):
                self._rate.took(*source)
                self._voices.take(item)
            if sequencer.set_back:
                self.reset(item.vue_id)
            elif sequencer.idle:
                return None
        self._touched.add(item.vue_id)
        if reason is not None:
            self._refuse(item, reason)
        return reason

    def _admits(self, item: Item | ImuSample, sound: bool) -> str | None:
        """Why the device of an item is not tracked, None where it is."""
        pose = isinstance(item, InitialPose)
        shut, leaves = self._admission.admit(item.vue_id, item.stamp_ns, sound=sound, pose=pose)
        if leaves is not None:
            for kept in (self._sequencers, self._tracks, self._clocks, self._untold):
                kept.pop(leaves, None)
            self._touched.discard(leaves)
            self.refusals.forget(leaves)
            self._left.append(leaves)
        return shut

    def take_left(self) -> list[str]:
        """Devices that made room for others since the last call."""
        left, self._left = self._left, []
        return left

    def has_fix(self, vue_id: str) -> bool:
        """Whether a device had a plausible fix: one that a later epoch agreed with."""
        return self._admission.is_fixed(vue_id)

    def lacks_something(self, vue_id: str) -> bool:
        """Whether a device has no first fix from all that came in the time for one: it needs what
        the device itself, or an operator, has to say."""
        return self._admission.waits_ns(vue_id) >= 1e9 * self._config.initial_window_s

    def _refuse(self, item: Item | ImuSample, reason: str) -> None:
        """Count what is refused, and tell of it where nothing else is told of the device."""
        track = self.track(item.vue_id)
        counted = f"imu_{reason}" if isinstance(item, ImuSample) else reason
        track.refused[counted] += 1
        sequencer = self._sequencers.get(item.vue_id)
        newest_ns = sequencer.newest_ns if sequencer is not None else 0
        self.refusals.refuse(item, reason, newest_ns)
        due = track.refused.total() % _TELL_EVERY == 1 and not track.has_estimate
        if due and is_vue_id(item.vue_id):
            self._untold[item.vue_id] = newest_ns or max(item.stamp_ns, 0)

    def floods(self, rsu_id: str, vue_id: str, stamp_ns: int) -> bool:
        """Whether a measurement is one too many of its RSU, or two senders speak in its name. It
        is then counted as refused and need not be added. A device that is not known stays so."""
        return self._shut(rsu_id, vue_id, stamp_ns) is not None

    def _shut(self, rsu_id: str, vue_id: str, stamp_ns: int) -> str | None:
        """Why a measurement is refused whatever it says, and counted; None where it is not."""
        if self._voices.refuses(rsu_id, vue_id, stamp_ns):
            reason = CONFLICT
        elif self._rate.exceeded(rsu_id, vue_id, stamp_ns):
            reason = RATE
        else:
            return None
        track = self._tracks.get(vue_id)
        if track is not None:
            track.refused[reason] += 1
        self.refusals.refuse_unread(rsu_id, vue_id, reason)
        return reason

    def concerns(self, measurement: RsuMeasurement) -> bool:
        """Whether a measurement is for this tracker: one of a network leaves those of RSUs it
        knows to be of other networks to their trackers."""
        network = self._config.network
        if not network:
            return True
        rsu = self._rsus.get(measurement.rsu_id)
        return rsu is None or rsu.info.network == network

    def _add_imu(self, sample: ImuSample) -> str | None:
        if not self._config.use_imu:
            return None
        reason = validation.imu_fault(sample) if self.enabled else "disabled"
        shut = self._admits(sample, reason is None)
        if shut is not None:
            return shut
        track = self.track(sample.vue_id)
        reason = reason or self._repeated(sample) or track.imu.add(sample)
        self._touched.add(sample.vue_id)
        if reason is None:
            self._sequencer(sample.vue_id).mark(IMU, sample.stamp_ns)
        else:
            self._refuse(sample, reason)
        return reason

    def process(self) -> list[TrackOutput]:
        """Apply every epoch that is complete, oldest first, device by device."""
        if not self._touched:
            return []
        touched, self._touched = self._touched, set()
        return self._apply(Sequencer.release, sorted(touched))

    def flush(self) -> list[TrackOutput]:
        """Apply all that is pending: the recording has ended, or nothing has come for a while."""
        return self._apply(Sequencer.flush, sorted(self._sequencers))

    def reset(self, vue_id: str | None = None) -> None:
        """Forget all tracks, or one, and what is pending; RSUs stay known. For a clock that jumped
        back."""
        if vue_id is None:
            self._health.reset()
            if self._shared is not None:
                self._shared.clear()
        for name in [vue_id] if vue_id is not None else list(self._tracks):
            self._rate.forget(name)
            self._voices.forget(name)
            dropped = self._sequencers.pop(name, None)
            if dropped is not None and dropped.set_back:
                self._clocks[name] = dropped.clocks
            self.track(name).reset()

    def rejected(self) -> dict[str, Counter[str]]:
        """Refused and rejected measurements by device and reason."""
        return {vue: track.rejected for vue, track in self._tracks.items()}

    def strangers(self) -> dict[str, dict[str, Stranger]]:
        """By device: sources whose clocks are not those of the others."""
        found = {vue: s.clocks.strangers() for vue, s in self._sequencers.items()}
        return {vue: strangers for vue, strangers in found.items() if strangers}

    def findings(
        self,
        statuses: Mapping[str, TrackStatus],
        silent_s: Mapping[str, float],
        unheard_s: float = 0.0,
        warnings: Sequence[str] = (),
    ) -> list[Finding]:
        """What an operator is told: the newest status by device, seconds for which nothing was
        told of a device, and of any (``unheard_s``); what is wrong with the input as a whole."""
        refused, descriptions = self.refusals, self.refusals.descriptions()
        strangers = {rsu: s for found in self.strangers().values() for rsu, s in found.items()}
        doors = refused.devices()
        devices = [
            diagnosis.of_device(status, doors.get(vue), silent_s.get(vue, 0.0))
            for vue, status in statuses.items()
        ]
        reports = self.rsu_reports(unheard_s)
        return [
            *devices,
            diagnosis.of_network(
                self.rsu_count, descriptions, [*warnings, *self._admission.warnings()]
            ),
            *diagnosis.of_rsus(
                reports,
                refused.rsus(),
                descriptions,
                strangers,
                self._errors,
                refused.refused_descriptions(),
            ),
        ]

    def coasting(self, vue_id: str, stamp_ns: int) -> TrackOutput | None:
        """Status of a device as of a later instant, until which nothing was heard of it; None
        unless it is COASTING then."""
        track = self._tracks.get(vue_id)
        status = track.status_at(stamp_ns) if track is not None and track.has_estimate else None
        if status is None or status.state is not TrackState.COASTING:
            return None
        return TrackOutput(None, None, status, network=self._config.network)

    def smoothed(self) -> dict[str, list[Odometry]]:
        """Odometry of every epoch given all measurements, by device; of a tracker that keeps
        posteriors."""
        return {vue: track.smoothed() for vue, track in self._tracks.items()}

    def rsu_reports(self, since_s: float = 0.0) -> list[RsuReport]:
        """Health of the RSUs as of ``since_s`` seconds after the newest measurement."""
        newest = max((s.newest_ns for s in self._sequencers.values()), default=0)
        return self._health.reports(newest + round(1e9 * since_s))

    def _apply(
        self, take: Callable[[Sequencer], list[Epoch]], vue_ids: Iterable[str]
    ) -> list[TrackOutput]:
        outputs: list[TrackOutput] = []
        for vue in vue_ids:
            sequencer = self._sequencers.get(vue)
            told = self._step(sequencer, self._tracks[vue], take) if sequencer is not None else []
            outputs += told
            for output in told:
                if output.odometry is not None and output.status.used:
                    self._admission.note_fix(vue, output.status.stamp_ns)
                for errors in output.errors:
                    self._errors[errors.rsu_id] = errors
            refused_ns = self._untold.pop(vue, None) if self._untold else None
            if refused_ns is not None and not told:
                words = self.refusals.of_device(vue).words()
                outputs.append(self.track(vue).waiting(refused_ns, words))
        return outputs

    def _step(
        self,
        sequencer: Sequencer,
        track: Track,
        take: Callable[[Sequencer], list[Epoch]],
    ) -> list[TrackOutput]:
        """Apply the epochs of one device that ``take`` takes, and what came late."""
        outputs: list[TrackOutput] = []
        late = sequencer.take_late()
        epochs = take(sequencer)
        if late:
            new, revised = track.revise(late)
            for epoch in new:
                sequencer.applied(epoch)
            if not epochs:
                outputs.append(revised)
        for epoch in epochs:
            said = track.step(epoch)
            # Before a first fix there is nothing to tell of between epochs, nor of a pose that was
            # given before this tracker came.
            old_pose = epoch.only_a_pose() and sequencer.newest_ns > epoch.stamp_ns + _OLD_POSE_NS
            if (epoch.items and not old_pose) or (said.odometry and not epoch.items):
                outputs.append(said)
        return outputs

    def _fault(self, item: Item) -> str | None:
        if not self.enabled:
            return "disabled"
        match item:
            case RsuMeasurement():
                fault = validation.measurement_fault(item, self._config.map_frame)
                if fault is not None:
                    return fault
                rsu = self._rsus.get(item.rsu_id)
                if rsu is None:
                    return "unknown_rsu"
                if int(item.fields) & REFERENCED:
                    other = self._rsus.get(item.reference_rsu_id)
                    fault = validation.difference_fault(item, rsu, other)
                    if fault is not None:
                        return fault
                return rsu.phase_fault() if int(item.fields) & _PHASE else None
            case Velocity():
                return validation.velocity_fault(item, self._config.map_frame)
            case GroundSpeed():
                return validation.speed_fault(item)
            case InitialPose():
                if not self._config.accept_initialpose:
                    return "initialpose_off"
                return validation.pose_fault(item, self._config.map_frame)

    def _contradicted(self, item: Item) -> str | None:
        if isinstance(item, RsuMeasurement) and self._voices.contradicts(item):
            return CONFLICT
        return None

    def _repeated(self, item: Item | ImuSample) -> str | None:
        if not self._config.isolate_rsus or isinstance(item, InitialPose):
            return None
        return REPEATED if self._repeats.stuck(item) else None

    def _sequencer(self, vue_id: str) -> Sequencer:
        if vue_id not in self._sequencers:
            self.track(vue_id)
            strapdown = self._config.is_strapdown
            rate_hz = self._config.odometry_rate_hz if strapdown else 0.0
            self._sequencers[vue_id] = Sequencer(
                int(self._config.hold_s * 1e9),
                self._config.require_initial_pose,
                int(self._config.history_s * 1e9),
                int(self._config.max_future_s * 1e9),
                tick_ns=round(1e9 / rate_hz) if rate_hz > 0.0 else 0,
                clocks=self._clocks.pop(vue_id, None),
                awaits=self._is_awaited,
            )
        return self._sequencers[vue_id]

    def _is_awaited(self, item: RsuMeasurement) -> bool:
        """Whether epochs wait for an RSU: one that has yet to prove itself delays nobody."""
        return not self._health.is_on_probation(item.rsu_id, item.vue_id, item.stamp_ns)

    def track(self, vue_id: str) -> Track:
        """Track of a device, new where there is none."""
        if vue_id not in self._tracks:
            track = Track(vue_id, self._config, self._rsus, self._health, self._shared)
            if self._keep_posteriors:
                track.record()
            self._tracks[vue_id] = track
        return self._tracks[vue_id]


def _admission_limits(config: TrackerConfig) -> tuple[int, str, int]:
    return config.max_devices, config.allowed_devices, round(1e9 * config.max_gap_s)
