"""Mean and covariance of one device, carried from epoch to epoch by the chosen filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netpos.estimation import densities, engine
from netpos.estimation.densities import Densities, Density
from netpos.estimation.engine import EpochInput
from netpos.estimation.forms.table import form_of
from netpos.estimation.level.protection import mixture_radius
from netpos.estimation.measurement import ROW_WIDTH
from netpos.estimation.mixture import epoch as mixtures
from netpos.estimation.mixture.epoch import Dynamics, Memory, Outcome
from netpos.estimation.mixture.gaussians import (
    LEAST_DENSITY_LOG,
    Mixture,
    log_densities,
    mode_of,
    moments,
    one_component,
)
from netpos.estimation.mixture.mirror import Mirror
from netpos.estimation.motion import NO_BIAS, Parameter
from netpos.estimation.state import N_CORE, POSITION, X
from netpos.estimation.update.robust import positive_normal
from netpos.messages.values import Array, TrackMode
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import (
    augmented,
    carries_modes,
    dynamics_of,
    motions_of,
    options_of,
    start_state,
)

_NO_ROWS = np.empty((0, ROW_WIDTH))
_FARTHEST_BEHIND_SD = 5.0  # one Gaussian error in three million


class UpdateResult(NamedTuple):
    """What an estimator made of the rows of one epoch.

    nis, dof : of the accepted rows together, and their number
    accepted : 1 or 0 for each group of rows
    outliers : probability of each group that it is an outlier
    innovations : (m, 2) innovation of each row at the prediction, and its standard deviation
    undetected_m : how far [m] a manoeuvre that nothing has shown may have taken the device
    sound : whether the posterior can be that of a device
    breaks : times a smoother cannot reach across this epoch
    """

    nis: float
    dof: int
    accepted: Sequence[float]
    outliers: Sequence[float]
    innovations: Array
    undetected_m: float = 0.0
    sound: bool = True
    breaks: int = 0


class Estimate:
    """One component in the compiled engine, or a mixture of them: while one does not explain the
    measurements, or where several motion models interact (``estimation.mixture``). It moves and is
    updated in the order of stamps; ``bias`` (2, k): sd and time constant of the bias states. Where
    no measurement tells the device from its image in a ``mirror``, one side alone is carried, and
    ``components`` has both."""

    mean: Array
    """State (n,) of the side that is carried."""
    mirror: Mirror | None = None
    """None: none, or the measurements have told the two sides apart since."""
    motion: Array
    """(Parameter,) of the last step; of no use to a smoother for interacting models."""
    declared_density: float
    """Density of the white acceleration [m/s^2/sqrt(Hz)] of a device of which nothing is
    learned."""

    def __init__(self, config: TrackerConfig, stamp_ns: int, mean: Array, cov: Array) -> None:
        """``mean``, ``cov``: as ``start_state`` takes them."""
        self.stamp_ns = stamp_ns
        self._open_s = 0.0  # of which no component says whether the device turned
        self._options = options_of(config)
        self._factored = not form_of(config.filter).carries_cov
        self._dynamics = dynamics_of(config, NO_BIAS)
        self.motion = self._dynamics.motions[0]
        self.declared_density = float(self.motion[Parameter.ACCEL])
        self._components: Mixture | None = None  # replaced, never changed; None: one component
        self._modes: tuple[TrackMode, ...] | None = None  # not yet asked for
        mean, cov = start_state(config, mean, cov)
        self.mean, self._cov_or_sqrt = mean.copy(), engine.to_cov_or_sqrt(cov, self._options)
        if self._options.models > 1:
            self._components = mixtures.a_component_each(mean, cov, self._dynamics)
        self._learned = self._unknown()
        self._accel_is_set = False
        self._rows = 0
        self._make_room(4)

    def _unknown(self) -> Densities:
        learns = self._options.learns_density
        unknown: Densities = densities.unknown_densities(self.mean.size, learns)
        return unknown

    def set_imu_increment(self, yaw_rad: float, speed_mps: float, gyro_density: float) -> None:
        """Set what the IMU integrated since ``stamp_ns``, and how good its yaw rate was."""
        self.motion[Parameter.YAW_INCREMENT] = yaw_rad
        self.motion[Parameter.SPEED_INCREMENT] = speed_mps
        self.motion[Parameter.GYRO] = gyro_density

    @property
    def accel_density(self) -> float:
        """Density of the white acceleration [m/s^2/sqrt(Hz)] from ``stamp_ns`` on where none is
        set: declared, or learned up to there."""
        if self._options.learns_density[Density.ACCEL]:
            return float(densities.density_of(self._learned, Density.ACCEL))
        return self.declared_density

    def set_process_noise(self, accel_density: float) -> None:
        """Set the density of the white acceleration [m/s^2/sqrt(Hz)] from ``stamp_ns`` up to the
        next epoch, from which none is learned."""
        self.motion[Parameter.ACCEL] = accel_density
        self._accel_is_set = True

    def set_config(self, config: TrackerConfig) -> None:
        """Go on with other live parameters (``live_parameters``)."""
        learned, self._options = self._options.learns_density, options_of(config)
        unknown, changed = self._unknown(), np.not_equal(learned, self._options.learns_density)
        for known, fresh in zip(self._learned, unknown, strict=True):
            known[changed] = fresh[changed]
        self._dynamics.motions[:, Parameter.ACCEL] = motions_of(config)[:, Parameter.ACCEL]
        self.declared_density = float(self.motion[Parameter.ACCEL])
        self._modes = None

    def _move_learned(self, dt_s: float, bias: Array) -> None:
        """Take the density that is set, learned or declared, and move what is learned with the
        state."""
        is_set, self._accel_is_set = self._accel_is_set, False
        learns = self._options.learns_density[Density.ACCEL] and not is_set
        phase = densities.LEARNED if learns else densities.HELD
        self._learned.phase[Density.ACCEL] = phase
        if not is_set:
            self.motion[Parameter.ACCEL] = self.declared_density
        densities.write_densities(self._learned, self.motion)
        densities.move(self._learned, self.mean, dt_s, self.motion, bias)

    def _with(self, bias: Array) -> Dynamics:
        return Dynamics(self._dynamics.motions, self._dynamics.sojourn_s, bias)

    def _make_room(self, rows: int) -> None:
        n = self.mean.size
        self._rows = max(rows, self._rows)
        self._memory: Memory = mixtures.memory_of(n, self._rows)
        self._one = Mixture(np.empty((1, n)), np.empty((1, n, n)), np.zeros(1))  # stands for it

    @property
    def cov(self) -> Array:
        """Covariance (n, n) of the side that is carried."""
        return (
            engine.to_cov(self._cov_or_sqrt, self._options)
            if self._factored
            else self._cov_or_sqrt
        )

    @property
    def prior(self) -> tuple[Array, Array]:
        """Mean and covariance predicted in the last ``step``."""
        return self._memory.step.prior_mean, self._memory.step.prior_cov

    def _set(self, mixture: Mixture) -> None:
        """Go on with ``mixture``; mean and covariance are those of all of them together."""
        self._components = mixture if mixture.log_weights.size > 1 else None
        self.mean, cov = moments(mixture)
        self._cov_or_sqrt = engine.to_cov_or_sqrt(cov, self._options)
        self._modes = None

    @property
    def _is_gaussian(self) -> bool:
        return self._components is None and self.mirror is None

    @property
    def _carried(self) -> Mixture:
        """The components of the side that is carried."""
        return self._components or one_component(self.mean, self.cov)

    @property
    def components(self) -> Mixture:
        """The components that the estimate has, on both sides of a mirror."""
        return self._carried if self.mirror is None else self.mirror.both_sides(self._carried)

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean and covariance of all ``components``."""
        if self.mirror is None:
            return self.mean, self.cov
        mean, cov = moments(self.components)
        return mean, cov

    def _tell_sides_apart(self) -> None:
        """Carry both sides of the mirror from now on."""
        both, self.mirror = self.components, None
        self._set(both)

    @property
    def likeliest(self) -> tuple[Array, Array]:
        """Mean and covariance of the most probable component that is carried. The mean of several
        may lie where the device cannot be: between two places, or inside an arc."""
        if self._components is None:
            return self.mean, self.cov
        best = int(np.argmax(self._components.log_weights))
        return self._components.means[best], self._components.covs[best]

    @property
    def modes(self) -> tuple[TrackMode, ...]:
        """Where the device may be while that is not decided: modes that carry more than the
        integrity risk, the most probable first; none where it is only one."""
        if self._is_gaussian:
            return ()
        if self._modes is None:
            self._modes = modes_of(self.components, self._options.integrity_risk)
        return self._modes

    @property
    def is_smoothable(self) -> bool:
        """Whether it is one place, on no side of a mirror: a smoother keeps one Gaussian."""
        return self.mirror is None and not self.modes

    @property
    def is_at_a_place(self) -> bool:
        """Whether the device can be where the mean is. The density there, over that at the place
        of the most probable component, is at least what a Gaussian has at 3 sd. The mean of a
        ring, or of two places that a row of components joins, is no such place."""
        if self._is_gaussian:
            return True
        every, (mean, _) = self.components, self.moments
        places = np.stack([mean, every.means[int(np.argmax(every.log_weights))]])[:, POSITION]
        here, peak = log_densities(every, places).tolist()
        return bool(here > peak + LEAST_DENSITY_LOG)

    def radius(self, level_m: float) -> float:
        """Radius [m] round the mean of all that holds ``level_m``, the level of the Gaussian, and
        all other places where the device may be."""
        if self._is_gaussian:
            return level_m
        risk = self._options.integrity_risk
        held: float = mixture_radius(self.components, self.moments[0], risk)
        return max(level_m, held)

    def augment(self, sd: Array) -> None:
        """Append independent states of mean 0 until there are 6 + len(sd)."""
        if self.mean.size >= N_CORE + sd.size:
            return
        if self._components is not None:
            self._set(_augmented(self._components, sd))
        else:
            mean, cov = augmented(self.mean, self.cov, sd)
            self.mean, self._cov_or_sqrt = mean, engine.to_cov_or_sqrt(cov, self._options)
        self._learned = densities.resized(self._learned, self.mean.size)
        self._make_room(self._rows)

    def change_prior(self, index: int, before: float, after: float) -> None:
        """Take the state ``index``, whose prior had mean 0 and sd ``before``, for one of sd
        ``after`` (``with_prior``)."""
        if before == after:
            return
        changed = with_prior(self._carried, index, before, after)
        if self._components is not None:
            self._set(changed)
            return
        self.mean = changed.means[0]
        self._cov_or_sqrt = engine.to_cov_or_sqrt(changed.covs[0], self._options)

    def keep_in_front(self, origin: Array, front: Array) -> None:
        """Where the mean is behind the line through ``origin`` (2,) m with ``front`` (2,), of unit
        length, across it, take away what is behind it, from each component that has its mean
        there."""
        if self.mirror is not None:
            self._tell_sides_apart()
        if float(front @ (self.mean[POSITION] - origin)) >= 0.0:
            return
        means, covs, log_weights = (array.copy() for array in self.components)
        for k in np.flatnonzero((means[:, POSITION] - origin) @ front < 0.0).tolist():
            log_weights[k] += cut_off_behind(means[k], covs[k], origin, front)
        log_weights -= np.logaddexp.reduce(log_weights)
        self._set(Mixture(means, covs, log_weights))

    def predict(self, stamp_ns: int, bias: Array) -> None:
        """Move to ``stamp_ns``."""
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        self.stamp_ns = stamp_ns
        self._open_s += dt
        self._modes = None
        self._move_learned(dt, bias)
        if self._components is None:
            engine.predict(self.mean, self._cov_or_sqrt, dt, self.motion, bias, self._options)
        elif dt > 0.0:
            dynamics = self._with(bias)
            self._set(mixtures.move(self._components, dt, _NO_ROWS, dynamics, self._options))

    def step(
        self, stamp_ns: int, unheard_s: float, rejected_in_row: int, rows: Array, bias: Array
    ) -> UpdateResult:
        """Move to ``stamp_ns`` and apply one epoch. ``prior`` holds the prediction afterwards."""
        n, m, height_m = self.mean.size, len(rows), self._options.height_m
        if self.mirror is not None and not self.mirror.leaves(rows, n, height_m):
            self._tell_sides_apart()
        if m > self._rows:
            self._make_room(m)
        memory = self._memory
        dt_s = (stamp_ns - self.stamp_ns) * 1e-9
        epoch = EpochInput(dt_s, unheard_s, self._open_s + dt_s, rejected_in_row, rows)
        self._move_learned(dt_s, bias)
        outcome: Outcome = mixtures.advance(
            self.mean,
            self._cov_or_sqrt,
            self._components or self._one,
            epoch,
            self._with(bias),
            self._options,
            memory,
        )
        self.stamp_ns = stamp_ns
        prior_mean, prior_cov = self.prior
        densities.learn(self._learned, prior_mean, prior_cov, self.mean, self.cov, outcome.turned)
        learns_clock = self._options.learns_density[Density.CLOCK]
        stepped = densities.clock_has_stepped(prior_mean, prior_cov, self.mean)
        self._open_s = outcome.open_s
        several = outcome.components.log_weights.size > 1
        self._components, self._modes = outcome.components if several else None, None
        if several and self.mirror is not None:
            self._set(self.mirror.one_side(outcome.components))
        return UpdateResult(
            outcome.nis,
            outcome.used,
            memory.step.accepted[: outcome.outliers.size].tolist(),
            outcome.outliers.tolist(),
            memory.innovations[:m].copy(),
            outcome.undetected_m,
            sound=not math.isnan(outcome.undetected_m),
            breaks=int(learns_clock and stepped),
        )

    def copy(self) -> Estimate:
        """An independent copy."""
        twin = Estimate.__new__(Estimate)
        twin.__dict__.update(self.__dict__)
        twin.mean, twin._cov_or_sqrt = self.mean.copy(), self._cov_or_sqrt.copy()
        twin._dynamics = self._dynamics._replace(motions=self._dynamics.motions.copy())
        twin.motion = twin._dynamics.motions[0]
        twin._learned = densities.resized(self._learned, self.mean.size)
        return twin


def _augmented(mixture: Mixture, sd: Array) -> Mixture:
    """Every component with the last entries of ``sd`` appended."""
    pairs = [augmented(m, c, sd) for m, c in zip(mixture.means, mixture.covs, strict=True)]
    means, covs = np.array([mean for mean, _ in pairs]), np.array([cov for _, cov in pairs])
    return Mixture(means, covs, mixture.log_weights)


def with_prior(mixture: Mixture, index: int, before: float, after: float) -> Mixture:
    """A mixture in which the state ``index``, whose prior had mean 0 and sd ``before``, has one of
    sd ``after``, both > 0.

    Narrower, the one prior is divided out of each component and the other multiplied in, which is
    exact while the state stays. Wider, the state gets noise up to the variance that this leaves
    it: little where it is known, all where nothing is. To move it to where it would then be is not
    stable: what the process has forgotten counts as news. A state that is known no better than its
    prior keeps its share of it.
    """
    means, covs, log_weights = (array.copy() for array in mixture)
    for k in range(log_weights.size):
        P, m = covs[k, :, index].copy(), means[k, index]
        taken = min(1.0, before * before / P[index]) * (before**-2 - after**-2)
        left = 1.0 - taken * P[index]
        if taken > 0.0:
            covs[k, index, index] /= left
            continue
        gain = taken / left
        means[k] += gain * m * P
        covs[k] += gain * np.outer(P, P)
        log_weights[k] += 0.5 * (gain * m * m - math.log(left))
    log_weights -= np.logaddexp.reduce(log_weights)
    return Mixture(means, covs, log_weights)


def cut_off_behind(mean: Array, cov: Array, origin: Array, front: Array) -> float:
    """Moments of a Gaussian without what is behind a line, in place: mean (n,), covariance (n, n);
    the line through ``origin`` (2,) m, with ``front`` (2,), of unit length, across it (Simon and
    Simon 2010, eq. 13 to 20 for one constraint). Nothing changes where the mean is more than
    ``_FARTHEST_BEHIND_SD`` behind it: that contradicts the estimate, it does not cut it.

    Returns the log of the share of the Gaussian in front of the line."""
    Ph = cov[:, POSITION] @ front
    sd = math.sqrt(float(front @ Ph[POSITION]))
    z = float(front @ (mean[POSITION] - origin)) / sd
    left, variance = positive_normal(z)
    if z > 0.0:
        share = math.log1p(-0.5 * math.erfc(z / math.sqrt(2.0)))
    else:  # by the density over the hazard rate left - z: no underflow far behind
        share = -0.5 * (z * z + math.log(2.0 * math.pi)) - math.log(left - z)
    if z < -_FARTHEST_BEHIND_SD:
        return share
    mean += Ph * ((left - z) / sd)
    cov -= np.outer(Ph, Ph) * ((1.0 - variance) / sd**2)
    return share


def modes_of(mixture: Mixture, risk: float) -> tuple[TrackMode, ...]:
    """Modes of a mixture that carry more than ``risk``, the most probable first; none where it is
    only one."""
    weights = np.exp(mixture.log_weights)
    if weights.max() >= 1.0 - risk:
        return ()
    mode = mode_of(mixture)
    sums = np.bincount(mode, weights)
    x, y = (np.bincount(mode, weights * mixture.means[:, a]) / sums for a in (X.PX, X.PY))
    modes = tuple(
        TrackMode(weight=float(sums[m]), x_m=float(x[m]), y_m=float(y[m]))
        for m in np.argsort(-sums, kind="stable").tolist()
        if sums[m] > risk
    )
    return modes if len(modes) > 1 else ()


def start_from(
    config: TrackerConfig, stamp_ns: int, mixture: Mixture, mirror: Mirror | None = None
) -> Estimate:
    """An estimate from the components of a first fix, which a ``mirror`` does not tell from their
    images; from their moments where it is one Gaussian."""
    if mirror is not None:
        mixture = mirror.one_side(mixture)
    estimate = Estimate(config, stamp_ns, *moments(mixture))
    estimate.mirror = mirror
    if mixture.log_weights.size > 1 and carries_modes(config):
        pairs = zip(mixture.means, mixture.covs, strict=True)
        states = [start_state(config, mean, cov) for mean, cov in pairs]
        means, covs = np.array([mean for mean, _ in states]), np.array([cov for _, cov in states])
        estimate._set(Mixture(means, covs, mixture.log_weights))
    return estimate
