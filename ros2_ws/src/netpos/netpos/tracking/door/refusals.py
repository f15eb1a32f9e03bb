"""What is refused at the door: counted by device and by RSU, and said in words.

A source of which nothing was ever refused costs nothing. Of another one the last ``WINDOW`` items
tell whether all it sends is refused, or some.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from netpos.messages.fields import MAP_FRAME, bad_stamp, malformed_nanosec
from netpos.messages.values import Field, GroundSpeed, ImuSample, RsuMeasurement, Velocity
from netpos.tracking.door.rate_limit import RATE
from netpos.tracking.door.validation import explanation
from netpos.tracking.door.voices import CONFLICT
from netpos.tracking.ordering.sequencer import Item

WINDOW = 50
"""Items of a source by which it is judged."""
SOURCES_MAX = 500
"""Sources remembered; the refusals of more are counted together."""
OTHERS = "others"

_SENTENCES = {
    "zero_stamp": "header.stamp is 0; set it to the time of emission",
    "bad_stamp": "{bad_stamp}",
    "no_fields": "fields is 0; set the bits of what was measured",
    "unknown_fields": "fields is {fields}, of which only the bits {known} have a meaning",
    "vue_id": "{vue_id!r} is no name of a topic; send letters, digits and _, at most 100",
    "lever_arm": "lever_arm is {lever_arm} m; send the place of the antenna in base_link",
    "no_reference": "reference_rsu_id is {reference!r}; name the RSU that the TDOA counts from",
    "unknown_reference": "no RsuInfo of the reference {reference!r} is known; publish it on"
    " /rsu/info, transient local",
    "tdoa_too_large": "tdoa is {tdoa:g} s, more than the distance of the two RSUs allows; are"
    " their clocks the same, and is it in seconds?",
    "no_baseline": "its RsuInfo has no baseline; give the distance of its antennas and the"
    " wavelength [m]",
    "frame": "frame_id is {frame!r}; give it in {map!r}",
    "unknown_rsu": "no RsuInfo of it is known; publish it on /rsu/info, transient local",
    "late": "its stamp is {behind:.3g} s behind the newest, more than hold_s and history_s allow",
    "future_stamp": "its stamp is {ahead:.3g} s ahead of all others",
    "clock_ahead": "its stamp is {ahead:.3g} s ahead of those of the other RSUs; set its clock",
    "duplicate": "another one with the same stamp came before it",
    CONFLICT: "two of the same stamp, or closer together than it ever sends, differ, neither is"
    " used; does somebody else send in its name?",
    "repeated": "its values stay the same to the last bit for longer than its noise and its past"
    " allow; is it stuck? With the next other value it is taken again",
    RATE: "more in a second of its stamps, or closer together, than max_rate_hz or"
    " max_rsu_rate_hz allow; stop its sender, or raise them",
    "initialpose_off": "initial poses are refused; set accept_initialpose to true",
    "disabled": "the tracker is disabled; call its service enable with data: true",
    "not_finite": "a value is not finite, or beyond 1e9",
    "variance": "a covariance is not symmetric and positive definite with sds from 1e-6 to 1e6",
}


@dataclass(frozen=True, slots=True)
class Refused:
    """What was refused of a source: counts since start by reason; of the last ``of`` items,
    ``last`` were; the sentence about the newest one."""

    counts: Mapping[str, int]
    last: int
    of: int
    sentence: str

    @property
    def all_of_it(self) -> bool:
        """Whether nothing of the source is taken."""
        return 0 < self.of == self.last

    def words(self) -> str:
        """For people; empty while nothing is refused any more."""
        if not self.last:
            return ""
        share = "all" if self.all_of_it else f"{self.last} of the last {self.of}"
        return f"{share} refused: {self.sentence}"


@dataclass(slots=True)
class _Door:
    counts: Counter[str] = field(default_factory=Counter)
    refused: deque[bool] = field(default_factory=lambda: deque(maxlen=WINDOW))
    sentence: str = ""

    def report(self) -> Refused:
        return Refused(dict(self.counts), sum(self.refused), len(self.refused), self.sentence)


class Refusals:
    """The refusals of a tracker."""

    def __init__(self, map_frame: str = MAP_FRAME) -> None:
        self._map_frame = map_frame
        self._devices: dict[str, _Door] = {}
        self._rsus: dict[str, _Door] = {}
        self._descriptions: dict[str, str] = {}
        self._refused_descriptions: Counter[str] = Counter()
        self.any = False
        """Whether anything was ever refused: what is taken counts from then on."""

    def refuse(self, item: Item | ImuSample, reason: str, newest_ns: int = 0) -> str:
        """Count an item that is refused; the sentence about it. ``newest_ns``: the newest stamp
        of its device."""
        self.any = True
        sentence = f"{reason}: {self._sentence(item, reason, newest_ns)}".removesuffix(": ")
        if isinstance(item, RsuMeasurement):
            _count(self._rsus, item.rsu_id, reason, sentence)
            sentence = f"{sentence} (from {item.rsu_id})"
        elif isinstance(item, Velocity | GroundSpeed):
            sentence = f"{sentence} (from {item.source})"
        _count(self._devices, item.vue_id, reason, sentence)
        return sentence

    def refuse_unread(self, rsu_id: str, vue_id: str, reason: str) -> None:
        """Count a measurement that is refused whatever it says, at the least cost."""
        self.any = True
        sentence = f"{reason}: {_SENTENCES[reason]}"
        _count(self._rsus, rsu_id, reason, sentence)
        _count(self._devices, vue_id, reason, f"{sentence} (from {rsu_id})")

    def take(self, item: Item | ImuSample) -> None:
        """Note that an item is taken."""
        door = self._devices.get(item.vue_id)
        if door is not None:
            door.refused.append(False)
        if isinstance(item, RsuMeasurement):
            door = self._rsus.get(item.rsu_id)
            if door is not None:
                door.refused.append(False)

    def forget(self, vue_id: str) -> None:
        """Of a device that is no longer tracked."""
        self._devices.pop(vue_id, None)

    def refuse_description(self, rsu_id: str, fault: str) -> None:
        """Note that the description of an RSU is refused, and why."""
        kept = rsu_id in self._descriptions or len(self._descriptions) < SOURCES_MAX
        if kept:
            self._descriptions[rsu_id] = fault
        self._refused_descriptions[rsu_id if kept else OTHERS] += 1

    def take_description(self, rsu_id: str) -> None:
        """Note that an RSU is known now."""
        self._descriptions.pop(rsu_id, None)

    def descriptions(self) -> dict[str, str]:
        """RSUs whose newest description is refused, and why."""
        return dict(self._descriptions)

    def refused_descriptions(self) -> dict[str, int]:
        """How many descriptions of each RSU were refused since start."""
        return dict(self._refused_descriptions)

    def of_device(self, vue_id: str) -> Refused:
        """What was refused of a device."""
        return self._devices.get(vue_id, _Door()).report()

    def devices(self) -> dict[str, Refused]:
        """Devices of which something was refused."""
        return {vue_id: door.report() for vue_id, door in sorted(self._devices.items())}

    def rsus(self) -> dict[str, Refused]:
        """RSUs of which something was refused."""
        return {rsu_id: door.report() for rsu_id, door in sorted(self._rsus.items())}

    def _sentence(self, item: Item | ImuSample, reason: str, newest_ns: int) -> str:
        if isinstance(item, RsuMeasurement):
            scalar = explanation(item, reason)
            if scalar:
                return scalar
            fault = self._descriptions.get(item.rsu_id)
            if reason == "unknown_rsu" and fault is not None:
                return f"its RsuInfo was refused: {fault}"
        ahead_s = (item.stamp_ns - newest_ns) * 1e-9
        return _SENTENCES.get(reason, "").format(
            fields=int(getattr(item, "fields", 0)),
            known=sum(int(known) for known in Field),
            vue_id=item.vue_id,
            lever_arm=getattr(item, "lever_arm", ()),
            reference=getattr(item, "reference_rsu_id", ""),
            tdoa=getattr(item, "tdoa_s", 0.0),
            frame=getattr(item, "frame_id", ""),
            bad_stamp=bad_stamp(malformed_nanosec(item.stamp_ns) or 0),
            map=self._map_frame,
            ahead=ahead_s,
            behind=-ahead_s,
        )


def _count(doors: dict[str, _Door], name: str, reason: str, sentence: str) -> None:
    door = doors.get(name)
    if door is None:
        name = name if len(doors) < SOURCES_MAX else OTHERS
        door = doors.setdefault(name, _Door())
    door.counts[reason] += 1
    door.refused.append(True)
    door.sentence = sentence
