"""What RSUs really measure, learned from how they contradict each other.

Every second the residuals of all RSUs are compared: what a shift of the position and of the clock
explains is taken out of them,

    r = h(x + d) - h(x) + b + n,   y = (r - h(x + d^) + h(x)) / sqrt(1 - leverage),

with d^ of least squares (``shift``), so that y scatters as the bias b and the noise n do
(studentised residuals, Cook and Weisberg 1982) and neither the motion model nor what the track
believes of the position is in it: a track that is wrong must not take its own error for that of
the RSUs. What y says of each RSU is in ``error_model``. Whether distances are too long by a share
that all have in common is learned beside it (``stretch``), by two hypotheses that hear the same
windows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import add
from typing import NamedTuple, Protocol

import numpy as np

from netpos.estimation.measurement import KIND, VALUE
from netpos.estimation.sensors.table import SENSORS
from netpos.messages.values import Array
from netpos.tracking.rsus.error_model import ErrorModel
from netpos.tracking.rsus.shift import unshifted
from netpos.tracking.rsus.stretch import NONE_SEEN, Stretch, together

WINDOW_S = 1.0
"""Values of an RSU within it count as one until their scatter says otherwise."""
_WINDOW_NS = round(WINDOW_S * 1e9)
_ALONE = 0.05  # 1 - leverage of a row that nobody checks
_SAME_UNIT = 0.01  # relative
_STRETCHING = [s.kind for s in SENSORS if s.stretches]

Name = tuple[str, str]
_STRETCH: Name = "distances", "stretch"
Models = dict[Name, ErrorModel]
Learned = ErrorModel | Stretch
Sums = tuple[float, ...]
"""Of the rows of a window: information, and that times residual; number, residual and its square
over the sd stated; half the square of the step from the value before; that value."""


class Others(Protocol):
    """What other devices have learned of the same RSUs."""

    def note(self, owner: tuple[str, int], stamp_ns: int, name: Name, learned: Learned) -> None:
        """Take what ``owner``, a device and the number of its life, has concluded."""

    def of_others(self, owner: tuple[str, int], stamp_ns: int, name: Name) -> list[Learned]:
        """What all but ``owner`` have concluded of ``name``."""


class _Window(NamedTuple):
    """What was heard of m RSUs and quantities in a window.

    rows : (m, ROW_WIDTH) the last of each; residual, variance : (m,) their mean, and its variance
    by what is stated; distance : (m,) m, 0 where it is none; scatter : of each what
    ``ErrorModel.scattered`` takes
    """

    names: list[Name]
    rows: Array
    residual: Array
    variance: Array
    distance: Array
    scatter: list[tuple[float, float, float]]

    @classmethod
    def of(cls, sums: Mapping[Name, Sums], newest: Mapping[Name, Array]) -> _Window:
        """What ``sums`` of rows, and the ``newest`` of them (ROW_WIDTH,), say."""
        names, total = list(sums), np.array(list(sums.values()))
        variance = 1.0 / total[:, 0]
        square = total[:, 4] - total[:, 3] ** 2 / total[:, 2]
        scatter = np.column_stack([square, total[:, 2] - 1.0, total[:, 5]]).tolist()
        rows = np.array([newest[name] for name in names])
        distance = np.where(np.isin(rows[:, KIND], _STRETCHING), rows[:, VALUE], 0.0)
        return cls(names, rows, total[:, 1] * variance, variance, distance, scatter)

    def moved(self, share: float) -> _Window:
        """With the residuals where ``share`` of the distance more had been left in."""
        return self._replace(residual=self.residual + share * self.distance)


class _Left(NamedTuple):
    """What the best shift of the device leaves of a window.

    residual, distance : (m,) over the sd of the residual; independent : (m,) part of the variance
    that is not the same from window to window; changed : whose models it changed
    """

    residual: Array
    distance: Array
    independent: Array
    changed: list[Name]


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
    window_ns: int = -1
    window: dict[Name, Sums] = field(default_factory=dict)
    newest: dict[Name, Array] = field(default_factory=dict)
    """The last row (ROW_WIDTH,) of each in the window."""

    def copy(self) -> LearnedErrors:
        """An independent copy."""
        return replace(
            self,
            models=self.models.copy(),
            unlikelier=self.unlikelier.copy(),
            window=self.window.copy(),
            newest=self.newest.copy(),
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

    def move(self, stamp_ns: int, speed_mps: float) -> None:
        """Note the way since the last call."""
        if self.moved_ns >= 0:
            self.moved_m += speed_mps * (stamp_ns - self.moved_ns) * 1e-9
        self.moved_ns = stamp_ns

    def hear(self, name: Name, row: Array, left: list[float], stated: float) -> None:
        """Note a row (ROW_WIDTH,), what is left of it by ``unexplained``, and the variance
        stated."""
        model = self.models[name]
        information, r = model.scale / left[2], left[0]
        z = r / math.sqrt(stated)
        old = self.window.get(name)
        step = 0.0 if old is None else 0.5 * (z - old[-1]) ** 2
        new = (information, information * r, 1.0, z, z * z, step)
        self.window[name] = (*(new if old is None else map(add, old, new)), z)
        self.newest[name] = row
        self.models[name] = model.heard(left[1] / stated)

    def conclude(self, stamp_ns: int, mean: Array, height_m: float) -> list[Name]:
        """Weigh a window that is over, seen from the mean (n,) of the posterior; whose models
        changed."""
        if self.window_ns < 0:
            self.window_ns = stamp_ns
        if stamp_ns < self.window_ns + _WINDOW_NS:
            return []
        sums, newest = self.window, self.newest
        self.window, self.newest, self.window_ns = {}, {}, stamp_ns
        if not sums:
            return []
        heard, seen_from = _Window.of(sums, newest), (mean, height_m)
        left = self._weigh(self.models, heard, stamp_ns, seen_from)
        for name in left.changed:
            _choose(self.models, name, self._known(name, stamp_ns, self.models[name].unit))
        if heard.distance.any():
            self._weigh_stretch(heard, left, stamp_ns, seen_from)
        for name in left.changed:
            self._tell(stamp_ns, name, self.models[name])
        return left.changed

    def _weigh(
        self, models: Models, heard: _Window, stamp_ns: int, seen_from: tuple[Array, float]
    ) -> _Left:
        """Weigh the candidates of ``models`` by a window, as far as RSUs check each other."""
        mine = [
            models[name].scattered(*of_it)
            for name, of_it in zip(heard.names, heard.scatter, strict=True)
        ]
        noise = np.array([m.scale for m in mine]) * heard.variance
        slow = np.array([m.bias_sd for m in mine]) ** 2
        sd = np.sqrt(noise + slow)
        left, checked, distance = unshifted(
            heard.rows, heard.residual, sd, *seen_from, heard.distance
        )
        changed = []
        for i, name in enumerate(heard.names):
            if checked[i] > _ALONE:
                y = float(left[i] / math.sqrt(checked[i]))
                models[name] = mine[i].weigh(
                    stamp_ns, self.moved_m, y, float(heard.variance[i]), float(checked[i])
                )
                changed.append(name)
        lasts = np.array([m.time_s(0.0) for m in mine]) * 2.0 / WINDOW_S
        independent = sd**2 / (noise + slow * np.maximum(lasts, 1.0))
        return _Left(left / sd, distance / sd, independent, changed)

    def _weigh_stretch(
        self, heard: _Window, left: _Left, stamp_ns: int, seen_from: tuple[Array, float]
    ) -> None:
        """Weigh the two hypotheses on the stretch by a window; ``left``: of the likelier one."""
        share = self.stretch.share
        other = heard.moved(share if self.stretched else -share)
        other_left = self._weigh(self.unlikelier, other, stamp_ns, seen_from)
        for name in other_left.changed:
            _choose(self.unlikelier, name, [])
        without, stretched = self.models, self.unlikelier
        if self.stretched:
            without, stretched, other_left = stretched, without, left
        gained = sum(stretched[name].log_fit - without[name].log_fit for name in stretched)
        self.own_stretch = self.own_stretch.seen(
            other_left.residual, other_left.distance, other_left.independent, share, gained
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
