"""What RSUs really measure, learned from how they contradict each other.

What all RSUs measured is compared in windows of a second, seen from the way of the device by the
velocities estimated: what a shift of that way and of the clock explains is taken out of it
(``shift``),

    r = h(x + d + w) - h(x) + b + n,

with any shift d and with w, by which the device may have moved otherwise within the window. Seen
from the estimates themselves, values would have the updates in them, which absorb what RSUs
disagree by, the more the fewer there are. What the others do not foresee of a residual
(studentised: Cook and Weisberg 1982) scatters as the bias b and the noise n do. What the track
believes of the position is not in it: a track that is wrong must not take its own error for that
of the RSUs. Where RSUs are heard so seldom that they do not check each other within a second, a
window goes on until they do.

What a window says of an RSU is in ``error_model``. Whether distances are too long by a share that
all have in common is learned beside it (``stretch``), by two hypotheses that hear the same
windows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np

from netpos.estimation.measurement import KIND, VALUE
from netpos.estimation.sensors.table import SENSORS
from netpos.messages.values import Array
from netpos.tracking.rsus.error_model import ErrorModel
from netpos.tracking.rsus.shift import DeviceState, Left, Way, unshifted
from netpos.tracking.rsus.stretch import NONE_SEEN, Stretch, together

WINDOW_S = 1.0
"""Length of a window; values of an RSU within it count as one until their scatter says
otherwise."""
_WINDOW_NS = round(WINDOW_S * 1e9)
_ENOUGH = 0.9  # of a measurement that others check
_LONGEST_NS = 10 * _WINDOW_NS
_ALONE = 0.05  # 1 - leverage of a row that nobody checks
_SAME_UNIT = 0.01  # relative
_STRETCHING = [s.kind for s in SENSORS if s.stretches]

Name = tuple[str, str]
_STRETCH: Name = "distances", "stretch"
Models = dict[Name, ErrorModel]
Learned = ErrorModel | Stretch


class _Heard(NamedTuple):
    """The values of an instant.

    gone : (3,) the way of the device until then; names : of whom the k values are;
    rows : (k, ROW_WIDTH); information : (k,) one over the variance of the update, by what is
    stated; left : (k,) what the update left of them, over the sd stated
    """

    stamp_ns: int
    gone: Array
    names: list[Name]
    rows: Array
    information: Array
    left: Array


class Others(Protocol):
    """What other devices have learned of the same RSUs."""

    def note(self, owner: tuple[str, int], stamp_ns: int, name: Name, learned: Learned) -> None:
        """Take what ``owner``, a device and the number of its life, has concluded."""

    def of_others(self, owner: tuple[str, int], stamp_ns: int, name: Name) -> list[Learned]:
        """What all but ``owner`` have concluded of ``name``."""


class _Window(NamedTuple):
    """What was heard of m RSUs and quantities in a window.

    way : with the mean of each; variance : (m,) of the means, by what is stated; more : (m,) to
    add to their residuals; distance : (m,) what they measure [m], 0 of other quantities;
    scatter : of each what ``ErrorModel.scattered`` takes
    """

    names: list[Name]
    way: Way
    variance: Array
    more: Array
    distance: Array
    scatter: list[tuple[float, float, float]]

    @classmethod
    def of(
        cls, heard: Sequence[_Heard], gone: Array, ends: tuple[DeviceState, DeviceState]
    ) -> _Window:
        """What was ``heard`` between the posteriors ``ends``; ``gone`` (3,): the way until the
        second."""
        of_name: dict[Name, list[int]] = {}
        for k, name in enumerate(name for instant in heard for name in instant.names):
            of_name.setdefault(name, []).append(k)
        rows, information, left = (
            np.concatenate([getattr(instant, what) for instant in heard])
            for what in ("rows", "information", "left")
        )
        mean_of, scatter = np.empty(len(rows), dtype=np.int64), []
        for i, of_it in enumerate(of_name.values()):
            mean_of[of_it], z = i, left[of_it]
            square, steps = float(((z - z.mean()) ** 2).sum()), float((np.diff(z) ** 2).sum())
            scatter.append((square, len(of_it) - 1.0, steps / 2.0))
        variance = 1.0 / np.bincount(mean_of, information)
        means = mean_of, information * variance[mean_of]
        instants = [(instant.stamp_ns, len(instant.names)) for instant in heard]
        to_go = gone - np.array([instant.gone for instant in heard])
        way = Way.of(rows, means, instants, to_go, ends)
        last = rows[[of_it[-1] for of_it in of_name.values()]]
        distance = np.where(np.isin(last[:, KIND], _STRETCHING), last[:, VALUE], 0.0)
        return cls(list(of_name), way, variance, np.zeros_like(distance), distance, scatter)

    def moved(self, share: float) -> _Window:
        """With the residuals where ``share`` of the distance more had been left in."""
        return self._replace(more=self.more + share * self.distance)


class _Seen(NamedTuple):
    """A window as the models of a hypothesis see it.

    models : of each, with the scatter within the window; left : what a shift leaves of it;
    independent : (m,) part of each variance that is not the same from window to window
    """

    models: list[ErrorModel]
    left: Left
    independent: Array

    @classmethod
    def of(cls, models: Models, window: _Window) -> _Seen:
        """What ``models`` see."""
        mine = [
            models[name].scattered(*of_it)
            for name, of_it in zip(window.names, window.scatter, strict=True)
        ]
        noise = np.array([m.scale for m in mine]) * window.variance
        slow = np.array([m.bias_sd for m in mine]) ** 2
        sd = np.sqrt(noise + slow)
        lasts = np.array([m.time_s(0.0) for m in mine]) * 2.0 / WINDOW_S
        left = unshifted(window.way, window.more, sd, window.distance)
        return cls(mine, left, sd**2 / (noise + slow * np.maximum(lasts, 1.0)))


@dataclass(slots=True)
class LearnedErrors:
    """Error models by the names of the bias states, of which the first part is the RSU or the
    network and the second the quantity. ``others``: what other devices know, and this one, as
    ``owner``, tells them."""

    others: Others | None = None
    owner: tuple[str, int] = ("", 0)
    models: Models = field(default_factory=dict)
    """Those of the likelier hypothesis on the stretch."""
    unlikelier: Models = field(default_factory=dict)
    """Those of the other one."""
    own_stretch: Stretch = NONE_SEEN
    stretch: Stretch = NONE_SEEN
    """With what others have seen of it."""
    stretched: bool = False
    """Whether it is likelier that there is one; rows leave it out then."""
    moved_m: float = 0.0
    moved_ns: int = -1
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    gone: Array = field(default_factory=lambda: np.zeros(3))
    """The way (3,) of the device and of its clock, by the velocities estimated."""
    heard: list[_Heard] = field(default_factory=list)
    """In the window that goes on."""
    before: DeviceState | None = None
    """With which the window before ended."""
    ends_ns: int = 0

    def copy(self) -> LearnedErrors:
        """An independent copy."""
        return replace(
            self,
            models=self.models.copy(),
            unlikelier=self.unlikelier.copy(),
            heard=self.heard.copy(),
        )

    def model(
        self, name: Name, noise_sd: float, bias_sd: float, time_s: float, stamp_ns: int = 0
    ) -> ErrorModel:
        """The model of ``name``, from its prior, and what others know by then, where it is new."""
        if name not in self.models:
            if not self.models:
                self._decide(stamp_ns)
            model = ErrorModel.declared(noise_sd, bias_sd, time_s)
            known = self._known(name, stamp_ns, model.unit)
            if known:
                model = model.scattering(
                    float(np.mean([other.gate_scale for other in known])),
                    tuple(np.mean([other.within for other in known], axis=0).tolist()),
                )
            self.models[name] = self.unlikelier[name] = model
            _choose(self.models, name, known)
            _choose(self.unlikelier, name, [])
        return self.models[name]

    def move(self, stamp_ns: int, velocity: Array, still: bool) -> None:
        """Note the way since the last call, by what is estimated of the velocity and of the drift
        (3,)."""
        if self.moved_ns >= 0:
            dt = (stamp_ns - self.moved_ns) * 1e-9
            self.gone = self.gone + 0.5 * dt * (self.velocity + velocity)
            self.moved_m += 0.0 if still else math.hypot(*velocity[:2].tolist()) * dt
        self.moved_ns, self.velocity = stamp_ns, velocity

    def hear(self, names: list[Name], rows: Array, left: Array, stated: Array) -> None:
        """Note the k values of an instant, to which the device has moved: whose they are, their
        rows (k, ROW_WIDTH), what is ``left`` (k, 3) of them by ``unexplained``, and the variances
        ``stated`` (k,)."""
        scale = np.array([self.models[name].scale for name in names])
        information, size = scale / left[:, 2], left[:, 0] / np.sqrt(stated)
        self.heard.append(_Heard(self.moved_ns, self.gone, names, rows, information, size))
        for name, ratio in zip(names, (left[:, 1] / stated).tolist(), strict=True):
            self.models[name] = self.models[name].heard(ratio)

    def conclude(self, posterior: DeviceState) -> list[Name]:
        """Weigh a window that is over with the epoch of a posterior; whose models changed."""
        stamp_ns, heard, before = posterior.stamp_ns, self.heard, self.before
        if before is None or not heard:
            self._begin(posterior)
            return []
        if stamp_ns < self.ends_ns:
            return []
        window = _Window.of(heard, self.gone, (before, posterior))
        seen = _Seen.of(self.models, window)
        others_come = any(more == 0.0 for _, more, _ in window.scatter)
        goes_on = seen.left.checked.sum() < (_ENOUGH if others_come else _ALONE)
        if goes_on and stamp_ns < before.stamp_ns + _LONGEST_NS:
            self.ends_ns = stamp_ns + _WINDOW_NS
            return []
        self._begin(posterior)
        changed = self._weigh(self.models, window, seen)
        for name in changed:
            _choose(self.models, name, self._known(name, stamp_ns, self.models[name].unit))
        if window.distance.any():
            self._weigh_stretch(window, seen)
        for name in changed:
            self._tell(stamp_ns, name, self.models[name])
        return changed

    def _begin(self, posterior: DeviceState) -> None:
        """Begin a window at a posterior."""
        self.heard, self.before = [], posterior
        self.ends_ns = posterior.stamp_ns + _WINDOW_NS

    def _weigh(self, models: Models, window: _Window, seen: _Seen) -> list[Name]:
        """Weigh the candidates of ``models`` by a window; whose changed."""
        left, changed = seen.left, []
        for i, name in enumerate(window.names):
            if left.checked[i] > _ALONE:
                of_it = left.residual[i], window.variance[i], left.checked[i]
                models[name] = seen.models[i].weigh(
                    window.way.after.stamp_ns, self.moved_m, *(float(value) for value in of_it)
                )
                changed.append(name)
        return changed

    def _weigh_stretch(self, window: _Window, seen: _Seen) -> None:
        """Weigh the two hypotheses on the stretch by a window, of which the likelier one has
        ``seen`` that."""
        share, stamp_ns = self.stretch.share, window.way.after.stamp_ns
        other = window.moved(share if self.stretched else -share)
        seen_by_other = _Seen.of(self.unlikelier, other)
        for name in self._weigh(self.unlikelier, other, seen_by_other):
            _choose(self.unlikelier, name, [])
        without, stretched = self.models, self.unlikelier
        if self.stretched:
            without, stretched = stretched, without
        of_stretched = seen if self.stretched else seen_by_other
        gained = sum(stretched[name].log_fit - without[name].log_fit for name in stretched)
        self.own_stretch = self.own_stretch.seen(
            of_stretched.left.white,
            of_stretched.left.beside,
            of_stretched.independent,
            share,
            gained,
        )
        self._decide(stamp_ns)
        self._tell(stamp_ns, _STRETCH, self.own_stretch)

    def _decide(self, stamp_ns: int) -> None:
        """Choose the hypothesis on the stretch by all that is known of it."""
        others = [s for s in self._of_others(_STRETCH, stamp_ns) if isinstance(s, Stretch)]
        self.stretch = together(self.own_stretch, others)
        if self.stretch.is_one(self.stretched) != self.stretched:
            self.stretched, given_up = not self.stretched, self.models
            self.models = {
                name: replace(model, scatter=given_up[name].scatter)
                for name, model in self.unlikelier.items()
            }
            self.unlikelier = given_up

    def _known(self, name: Name, stamp_ns: int, unit: float) -> list[ErrorModel]:
        """The models of others, of the same ``unit``."""
        found = self._of_others(name, stamp_ns)
        models = [model for model in found if isinstance(model, ErrorModel)]
        return [m for m in models if abs(m.unit - unit) <= _SAME_UNIT * unit]

    def _of_others(self, name: Name, stamp_ns: int) -> list[Learned]:
        return [] if self.others is None else self.others.of_others(self.owner, stamp_ns, name)

    def _tell(self, stamp_ns: int, name: Name, learned: Learned) -> None:
        if self.others is not None:
            self.others.note(self.owner, stamp_ns, name, learned)


def _choose(models: Models, name: Name, known: Sequence[ErrorModel]) -> None:
    """Weigh the candidates of ``name`` by what it measured itself, of any device, those of other
    devices as ``known``, and by the mean of what the others of its kind did, as if it were one
    measurement of theirs."""
    mine = models[name]
    others = [m.evidence for n, m in models.items() if n[1] == name[1] and n != name]
    log_weights = mine.prior + mine.evidence
    if others:
        log_weights = log_weights + np.mean(others, axis=0)
    for of_other in known:
        log_weights = log_weights + of_other.evidence
    models[name] = mine.weighed(log_weights)
