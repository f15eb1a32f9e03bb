"""The RSUs a tracker knows, and who may say where they are."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from netpos.messages.fields import MAP_FRAME
from netpos.messages.values import RsuInfo
from netpos.tracking.door import validation
from netpos.tracking.door.refusals import SOURCES_MAX, Refusals
from netpos.tracking.rsus.rsu import Rsu

MOVED_M = 0.01
"""A description that repeats a pose repeats it to this distance."""
MOVED_RAD = math.radians(0.1)
"""And to this angle."""
_FIXED = ("network", "angle_convention", "baseline_m", "wavelength_m")


class Register:
    """RSUs by name, under one rule of trust.

    ``listed``: those of the list, exactly as the list describes them. ``first``: the list, then
    whoever comes; the first pose of each stands. ``any``: whoever comes, with its newest pose.
    """

    def __init__(
        self,
        trust: str,
        listed: Iterable[RsuInfo],
        refusals: Refusals,
        map_frame: str = MAP_FRAME,
    ) -> None:
        """``map_frame``: what descriptions call the frame of their poses; that of the list is
        understood.

        Raises ``ValueError`` for an unsound list, or ``listed`` without a list."""
        self._trust, self._map_frame = trust, map_frame
        self._refusals = refusals
        self._pending: dict[str, RsuInfo] = {}
        self.known: dict[str, Rsu] = {}
        """What tracks read; it stays the same object."""
        for info in listed:
            fault = validation.rsu_fault(info)
            if fault is not None:
                raise ValueError(f"the list of RSUs is refused: {fault}")
            self.known[info.rsu_id] = Rsu.of(info)
        self._listed = frozenset(self.known)
        if trust == "listed" and not self._listed:
            raise ValueError("trust is listed, but no list of RSUs is given; set rsus_file")

    def add(self, info: RsuInfo) -> None:
        """Take a description; raises ``ValueError``, and counts it, where it is refused."""
        fault = validation.rsu_fault(info, self._map_frame) or self._contradiction(info)
        if fault is not None:
            self._refusals.refuse_description(info.rsu_id, fault)
            raise ValueError(f"RSU refused: {fault}")
        if info.rsu_id not in self._pending:
            self._refusals.take_description(info.rsu_id)
        if self._trust == "listed":
            return
        old = self.known.get(info.rsu_id)
        self.known[info.rsu_id] = Rsu.of(info if self._trust == "any" else _at(old, info))

    def accept(self) -> list[str]:
        """Let the newest refused pose of each known RSU hold; the names, sorted. An operator says
        so."""
        names = sorted(self._pending)
        for name in names:
            self.known[name] = Rsu.of(self._pending.pop(name))
            self._refusals.take_description(name)
        return names

    def _contradiction(self, info: RsuInfo) -> str | None:
        """Why a sound description is not trusted."""
        name = info.rsu_id
        if self._trust == "any":
            return None
        old = self.known.get(name)
        if old is None:
            if self._trust == "first":
                return None
            return f"{name} is not in rsus_file; add it there, or set trust to first"
        fault = _difference(old.info, info)
        if fault is None:
            return None
        if self._trust == "listed":
            return f"{fault} in rsus_file; correct {name}, or the file and start again"
        if name in self._pending or len(self._pending) < SOURCES_MAX:
            self._pending[name] = info
        return f"{fault} before; if it is right, call the service accept_rsus"


def _difference(old: RsuInfo, new: RsuInfo) -> str | None:
    """What of a description that must stay is not as it was."""
    moved_m = float(np.linalg.norm(new.position - old.position))
    if moved_m > MOVED_M:
        return f"{new.rsu_id} says it is {moved_m:.3g} m from where it was"
    cosine = min(1.0, abs(float(new.quaternion @ old.quaternion)))
    turned_rad = 2.0 * math.acos(cosine)
    if turned_rad > MOVED_RAD:
        turned_deg = math.degrees(turned_rad)
        return f"{new.rsu_id} says it is turned by {turned_deg:.3g} deg from where it was"
    for name in _FIXED:
        was, says = getattr(old, name), getattr(new, name)
        if was != says:
            return f"{new.rsu_id} says its {name} is {says!r}, it was {was!r}"
    return None


def _at(old: Rsu | None, info: RsuInfo) -> RsuInfo:
    """A description at the pose that stands, so that small moves never add up."""
    if old is None:
        return info
    return replace(info, position=old.info.position, quaternion=old.info.quaternion)
