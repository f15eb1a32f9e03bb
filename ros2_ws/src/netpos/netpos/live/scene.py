"""What is on the map now: buildings, RSUs, devices and how sure their trackers are of them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from netpos.live.shapes import Colour, Kind, Shape, circle, ellipse_axes
from netpos.messages.fields import MAP_FRAME, NS
from netpos.messages.values import (
    Array,
    Odometry,
    RsuInfo,
    RsuMeasurement,
    TrackMode,
    TrackState,
    TrackStatus,
)
from netpos.world.frames import yaw_from_quaternion

ELLIPSE_PROBABILITY = 0.95
ELLIPSE_SCALE = math.sqrt(-2.0 * math.log(1.0 - ELLIPSE_PROBABILITY))  # two dimensions
# In lengths of a device's arrow:
MODE_RADIUS = 1.5  # of a mode with probability 1; the area goes with the probability
LINE_WIDTH = 0.075
RSU_LENGTH, RSU_WIDTH = 0.75, 0.3
LETTER = 0.5  # height of a device's name; RSUs and modes have smaller ones
SMALL_LETTER = 0.375

STATE_COLOURS: dict[TrackState, Colour] = {
    TrackState.WAITING: (0.6, 0.6, 0.6, 1.0),
    TrackState.INITIALISING: (0.94, 0.89, 0.26, 1.0),
    TrackState.TRACKING: (0.0, 0.62, 0.45, 1.0),
    TrackState.COASTING: (0.84, 0.37, 0.0, 1.0),
    TrackState.AMBIGUOUS: (0.8, 0.47, 0.65, 1.0),
}
RSU_COLOUR: Colour = (0.4, 0.8, 0.4, 1.0)
BUILDING_COLOUR: Colour = (0.62, 0.6, 0.55, 0.6)
LEVEL_COLOUR: Colour = (0.9, 0.6, 0.0, 0.9)
TEXT_COLOUR: Colour = (0.95, 0.95, 0.95, 1.0)
SIGHT_COLOURS: dict[bool | None, Colour] = {
    True: (0.34, 0.71, 0.91, 0.8),  # fused
    False: (0.84, 0.1, 0.11, 0.9),  # refused
    None: (0.6, 0.6, 0.6, 0.6),  # not yet known
}

Device = tuple[str, str]
"""Network and device; the network is "" for a fused track, or where there is only one."""


def _parameter(default: float, low: float, high: float, text: str) -> Any:
    return field(default=default, metadata={"low": low, "high": high, "text": text})


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """How much of the past is shown, and how large things are drawn."""

    silent_s: float = _parameter(
        10.0, 0.1, 3600.0, "a device vanishes after this time without an estimate [s]"
    )
    sight_s: float = _parameter(
        0.25,
        0.0,
        3600.0,
        "lines go to RSUs heard up to this time before the device's newest epoch [s]",
    )
    path_points: int = field(
        default=1000, metadata={"low": 2, "high": 100_000, "text": "points of a path at most"}
    )
    path_step_m: float = _parameter(
        0.5, 0.0, 1000.0, "smallest distance between points of a path, except the newest [m]"
    )
    building_height_m: float = _parameter(
        10.0, 0.1, 1000.0, "height buildings are drawn with; scenarios do not give one [m]"
    )
    size_m: float = _parameter(
        4.0, 0.01, 1000.0, "length of a device's arrow; RSUs, names and lines in proportion [m]"
    )


@dataclass(slots=True)
class _Heard:
    """The newest measurement of one device by one RSU; accepted: what the status of its epoch
    says, None while that is not known."""

    stamp_ns: int
    accepted: bool | None = None


class _Track:
    """What is known of one device."""

    def __init__(self, path_points: int) -> None:
        self.odometry: Odometry | None = None
        self.status: TrackStatus | None = None
        self.estimated_s = self.told_s = -math.inf
        self.heard: dict[str, _Heard] = {}
        self.path: deque[tuple[int, Array]] = deque(maxlen=path_points)


class Scene:
    """Takes published messages, returns shapes. ``now_s``: the viewer's steady clock [s]."""

    def __init__(self, config: SceneConfig | None = None) -> None:
        self.config = config or SceneConfig()
        self.refused: dict[str, int] = {}
        """Number of messages that were not drawn, by reason."""
        self._buildings: Array = np.zeros((0, 4))
        self._rsus: dict[str, RsuInfo] = {}
        self._tracks: dict[Device, _Track] = {}

    def set_buildings(self, buildings: Array) -> None:
        """(k, 4) rectangles x_min, y_min, x_max, y_max [m]."""
        self._buildings = buildings

    def add_rsu(self, info: RsuInfo) -> None:
        """Add an RSU, or move it."""
        if info.frame_id != MAP_FRAME:
            self._refuse("RsuInfo not in map")
        elif not (np.isfinite(info.position).all() and np.isfinite(info.quaternion).all()):
            self._refuse("RsuInfo not finite")
        else:
            self._rsus[info.rsu_id] = info

    def clear_rsus(self) -> None:
        """Forget all RSUs; they will be described anew."""
        self._rsus.clear()
        for track in self._tracks.values():
            track.heard.clear()

    def add_measurement(self, measured: RsuMeasurement) -> None:
        """Note that an RSU has heard a device."""
        info = self._rsus.get(measured.rsu_id)
        if info is None:
            return
        track = self._tracks.get((info.network, measured.vue_id)) or self._tracks.get(
            ("", measured.vue_id)
        )
        if track is None:
            return
        heard = track.heard.setdefault(measured.rsu_id, _Heard(measured.stamp_ns))
        heard.stamp_ns = measured.stamp_ns

    def add_odometry(self, odometry: Odometry, network: str, now_s: float) -> None:
        """Take an estimate; it replaces the last one if it has the same stamp."""
        if not (np.isfinite(odometry.position).all() and np.isfinite(odometry.pose_cov).all()):
            self._refuse("odometry not finite")
            return
        track = self._track(network, odometry.vue_id)
        track.odometry, track.estimated_s = odometry, now_s
        self._extend(track.path, odometry)

    def add_status(self, status: TrackStatus, network: str, now_s: float) -> None:
        """Take a status, which says which RSUs of its epoch were fused."""
        figures = [status.position_sd_m, status.protection_level_m]
        figures += [value for mode in status.modes for value in (mode.weight, mode.x_m, mode.y_m)]
        if not all(map(math.isfinite, figures)):
            self._refuse("track_status not finite")
            return
        track = self._track(network, status.vue_id)
        track.status, track.told_s = status, now_s
        for rsu_id, heard in track.heard.items():
            if heard.stamp_ns == status.stamp_ns:
                heard.accepted = rsu_id in status.sources

    def map_shapes(self) -> list[Shape]:
        """Buildings and RSUs, which seldom change."""
        return [*self._drawn_buildings(), *self._drawn_rsus()]

    def shapes(self, now_s: float) -> list[Shape]:
        """All shapes of the devices that are not silent."""
        return [
            shape
            for device, track in sorted(self._live(now_s))
            for shape in self._drawn(device, track)
        ]

    def paths(self, now_s: float) -> dict[Device, list[tuple[int, Array]]]:
        """Stamp [ns] and position (3,) [m] of every device that is not silent, the oldest
        first."""
        return {device: list(track.path) for device, track in self._live(now_s)}

    def _track(self, network: str, vue_id: str) -> _Track:
        return self._tracks.setdefault((network, vue_id), _Track(self.config.path_points))

    def _live(self, now_s: float) -> Iterator[tuple[Device, _Track]]:
        """Devices with an estimate; those silent for long are forgotten. A status alone puts
        nothing on the map: the device may be silent."""
        for device in list(self._tracks):
            track = self._tracks[device]
            if now_s - track.estimated_s <= self.config.silent_s:
                yield device, track
                continue
            track.odometry = None
            track.path.clear()
            if now_s - track.told_s > self.config.silent_s:
                del self._tracks[device]

    def _refuse(self, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1

    def _extend(self, path: deque[tuple[int, Array]], odometry: Odometry) -> None:
        """Append the newest position. The one before it stays if it is ``path_step_m`` or more
        from its predecessor."""
        if path and odometry.stamp_ns < path[-1][0]:
            path.clear()  # time was set back: a new run
        if path and path[-1][0] == odometry.stamp_ns:
            path.pop()
        elif len(path) >= 2:
            step = path[-1][1] - path[-2][1]
            if float(np.hypot(step[0], step[1])) < self.config.path_step_m:
                path.pop()
        path.append((odometry.stamp_ns, odometry.position))

    def _drawn_buildings(self) -> Iterator[Shape]:
        height = self.config.building_height_m
        for k, (x_min, y_min, x_max, y_max) in enumerate(self._buildings.tolist()):
            yield Shape(
                group="buildings",
                name=str(k),
                kind=Kind.BOX,
                colour=BUILDING_COLOUR,
                position=((x_min + x_max) / 2, (y_min + y_max) / 2, height / 2),
                size=(x_max - x_min, y_max - y_min, height),
            )

    def _drawn_rsus(self) -> Iterator[Shape]:
        size = self.config.size_m
        for info in self._rsus.values():
            x, y, z = (float(value) for value in info.position)
            yield Shape(
                group="rsus",
                name=info.rsu_id,
                kind=Kind.ARROW,  # along the boresight
                colour=RSU_COLOUR,
                position=(x, y, z),
                yaw_rad=float(yaw_from_quaternion(info.quaternion)),
                size=(RSU_LENGTH * size, RSU_WIDTH * size, RSU_WIDTH * size),
            )
            yield Shape(
                group="rsu names",
                name=info.rsu_id,
                kind=Kind.TEXT,
                colour=TEXT_COLOUR,
                position=(x, y, z + LETTER * size),
                size=(0.0, 0.0, SMALL_LETTER * size),
                text=info.rsu_id,
            )

    def _drawn(self, device: Device, track: _Track) -> Iterator[Shape]:
        assert track.odometry is not None
        name = "/".join(part for part in device if part)
        x, y, z = (float(value) for value in track.odometry.position)
        status = track.status
        state = TrackState.WAITING if status is None else status.state
        length = self.config.size_m
        yield Shape(
            group="devices",
            name=name,
            kind=Kind.ARROW,
            colour=STATE_COLOURS[state],
            position=(x, y, z),
            yaw_rad=float(yaw_from_quaternion(track.odometry.quaternion)),
            size=(length, length / 3, length / 3),
        )
        yield Shape(
            group="device names",
            name=name,
            kind=Kind.TEXT,
            colour=TEXT_COLOUR,
            position=(x, y, z + LETTER * length),
            size=(0.0, 0.0, LETTER * length),
            text=f"{name} {state.name}",
        )
        yield _ellipse(name, track.odometry, status)
        if status is not None and status.protection_level_m >= 0.0:
            width = LINE_WIDTH * length
            yield _ring("protection levels", name, (x, y, z), status.protection_level_m, width)
        for k, mode in enumerate(() if status is None else status.modes):
            yield from _mode(f"{name} {k}", mode, z, length)
        yield from self._sights(name, track)

    def _sights(self, name: str, track: _Track) -> Iterator[Shape]:
        """Lines from each RSU that was heard in the last epochs."""
        assert track.odometry is not None
        oldest_ns = track.odometry.stamp_ns - round(NS * self.config.sight_s)
        for rsu_id, heard in sorted(track.heard.items()):
            if heard.stamp_ns < oldest_ns:
                continue
            yield Shape(
                group="lines of sight",
                name=f"{rsu_id} {name}",
                kind=Kind.LINE,
                colour=SIGHT_COLOURS[heard.accepted],
                size=(LINE_WIDTH * self.config.size_m, 0.0, 0.0),
                points=np.array([self._rsus[rsu_id].position, track.odometry.position]),
            )


def _ellipse(name: str, odometry: Odometry, status: TrackStatus | None) -> Shape:
    """Where the device is with a probability of 95 %. If the status is newer than the estimate,
    the device was not heard since, and only a standard deviation is known: a circle."""
    major, minor, angle = ellipse_axes(odometry.pose_cov[:2, :2], ELLIPSE_SCALE)
    if status is not None and status.stamp_ns > odometry.stamp_ns and status.position_sd_m > 0:
        major = minor = ELLIPSE_SCALE * status.position_sd_m
    state = TrackState.WAITING if status is None else status.state
    red, green, blue, _ = STATE_COLOURS[state]
    x, y, z = (float(value) for value in odometry.position)
    return Shape(
        group="ellipses",
        name=name,
        kind=Kind.DISC,
        colour=(red, green, blue, 0.4),
        position=(x, y, z),
        yaw_rad=angle,
        size=(2.0 * major, 2.0 * minor, 0.05),
    )


def _ring(
    group: str, name: str, centre: tuple[float, float, float], radius_m: float, width_m: float
) -> Shape:
    return Shape(
        group=group,
        name=name,
        kind=Kind.LINE,
        colour=LEVEL_COLOUR,
        size=(width_m, 0.0, 0.0),
        points=circle(centre, radius_m),
    )


def _mode(name: str, mode: TrackMode, z_m: float, size_m: float) -> Iterator[Shape]:
    """A disc whose area is proportional to the probability, and the probability as text."""
    red, green, blue, _ = STATE_COLOURS[TrackState.AMBIGUOUS]
    diameter = 2.0 * MODE_RADIUS * size_m * math.sqrt(max(mode.weight, 0.0))
    yield Shape(
        group="modes",
        name=name,
        kind=Kind.DISC,
        colour=(red, green, blue, 0.5),
        position=(mode.x_m, mode.y_m, z_m),
        size=(diameter, diameter, 0.05),
    )
    yield Shape(
        group="mode weights",
        name=name,
        kind=Kind.TEXT,
        colour=TEXT_COLOUR,
        position=(mode.x_m, mode.y_m, z_m + SMALL_LETTER * size_m),
        size=(0.0, 0.0, SMALL_LETTER * size_m),
        text=f"{100.0 * mode.weight:.0f} %",
    )
