"""Primary, secondary and tertiary stage of one object over a whole run, for many seeds.

No fix is gated here, so covariances and gains do not depend on the noise: they are worked out once
per setting, by the same code that runs in the nodes, and every seed costs one compiled pass per
network.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from netpos.estimation.engine import Epochs, empty_run
from netpos.estimation.intersection import METHODS, fuse_pair
from netpos.estimation.measurement import GATE_VARIANCE, GROUP, ROW_WIDTH, VALUE, VARIANCE
from netpos.estimation.mixture.epoch import run_epochs
from netpos.estimation.motion import NO_BIAS
from netpos.estimation.state import POSITION, X
from netpos.messages.values import Array, Field, NetworkTrack, RsuInfo, RsuMeasurement
from netpos.radio.noise import generator
from netpos.reproduction.dvornikov2017.truth import START_NS
from netpos.scenario.networks import fix_errors
from netpos.scenario.schema import NS
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.epoch_rows import epoch_rows_of
from netpos.tracking.estimators.estimates import Estimate
from netpos.tracking.estimators.models import dynamics_of, options_of
from netpos.tracking.networks.common_instant import TRACK_STATES, at_common_instant, step_matrices
from netpos.tracking.networks.secondary import OwnNoise, Secondary
from netpos.tracking.rsus.rsu import Rsu

Ints = npt.NDArray[np.int64]
Truth = Callable[[int, Ints], Array]
"""States (n, 6) of an object under a seed at stamps (n,)."""

VUE = "vue_1"
CENTRAL = "centralised"


@dataclass(frozen=True, slots=True, kw_only=True)
class FixNetwork:
    """A network that fixes an object with ``sd_m`` per axis every ``interval_s``, first after
    ``phase_s``."""

    name: str
    sd_m: float
    interval_s: float = 0.5
    phase_s: float = 0.0

    def stamps_ns(self, duration_s: float) -> Ints:
        """Stamps (n,) of its fixes."""
        first, step = round(self.phase_s * NS), round(self.interval_s * NS)
        return START_NS + np.arange(first, round(duration_s * NS) + 1, step, dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One object seen by two networks. ``start_var``: of every state at the start, of an error
    all filters share."""

    name: str
    networks: tuple[FixNetwork, FixNetwork]
    tracker: TrackerConfig
    truth: Truth
    duration_s: float
    start_var: float = 1e3


def common_stamps_ns(setting: Setting) -> Ints:
    """The common instants: every fix of the network that is last."""
    stamps = [network.stamps_ns(setting.duration_s) for network in setting.networks]
    return max(stamps, key=lambda network_stamps: int(network_stamps[0]))


def position_rows(fixes: Array, sd_m: Array) -> Array:
    """Filter rows (2 n, ROW_WIDTH) of fixes (n, 2) with standard deviations (n,): those a tracker
    makes of them."""
    info = Rsu.of(RsuInfo(rsu_id="fix", position=np.zeros(3)))
    probe = RsuMeasurement(
        stamp_ns=1,
        rsu_id="fix",
        vue_id=VUE,
        fields=Field.POSITION,
        position=np.ones(3),
        position_cov=np.eye(3),
    )
    template = epoch_rows_of([probe], {"fix": info}, None).rows
    rows = np.tile(template, (len(fixes), 1)).reshape(len(fixes), 2, ROW_WIDTH)
    rows[:, :, VALUE] *= fixes
    for column in (VARIANCE, GATE_VARIANCE):
        rows[:, :, column] *= sd_m[:, None] ** 2
    rows[:, :, GROUP] = 0
    return rows.reshape(-1, ROW_WIDTH)


class Pass:
    """One filter over the fixes of one network, or of several in the order of their stamps."""

    def __init__(self, setting: Setting, networks: Sequence[FixNetwork]) -> None:
        stamps = [network.stamps_ns(setting.duration_s) for network in networks]
        which = [np.full(s.size, i) for i, s in enumerate(stamps)]
        order = np.argsort(np.concatenate(stamps), kind="stable")
        self.stamps_ns: Ints = np.concatenate(stamps)[order]
        self._which = np.concatenate(which)[order]
        self._networks = networks
        self._sd = np.array([network.sd_m for network in networks])[self._which]
        self._setting = setting
        config = setting.tracker
        self._options = options_of(config)
        # the start of the run comes first, without a fix
        self._epochs = np.concatenate([[START_NS], self.stamps_ns])
        self._row_start = np.concatenate([[0], 2 * np.arange(len(self.stamps_ns) + 1)])
        cov = np.zeros((8, 8))
        cov[TRACK_STATES, TRACK_STATES] = setting.start_var
        cov[X.CLOCK, X.CLOCK] = cov[X.DRIFT, X.DRIFT] = 1.0
        self._start_cov = cov

    def fixes(self, seed: int, truth: Array, vue: str = VUE) -> Array:
        """Primary stage: fixes (n, 2) around the true states (n, 6)."""
        error = np.empty((self.stamps_ns.size, 2))
        for i, network in enumerate(self._networks):
            mine = self._which == i
            stamps = self.stamps_ns[mine]
            error[mine] = fix_errors(stamps, network.sd_m, seed, network.name, vue)[:, :2]
        return truth[:, :2] + error

    def run(self, fixes: Array, start: Array) -> tuple[Array, Array]:
        """Secondary stage: means (n, 6) and covariances (n, 6, 6) after each fix."""
        n = self._epochs.size
        mean = np.zeros(8)
        mean[TRACK_STATES] = start
        run = empty_run(n, 8)
        epochs = Epochs(self._epochs, self._row_start, position_rows(fixes, self._sd))
        dynamics = dynamics_of(self._setting.tracker, NO_BIAS)
        run_epochs(epochs, mean, self._start_cov, dynamics, self._options, run)
        kept = np.ix_(np.arange(1, n), TRACK_STATES, TRACK_STATES)
        return run.means[1:, TRACK_STATES], run.covs[kept]

    def own_covs(self) -> Array:
        """(n, 6, 6) what the fixes' own noise makes of the covariances."""
        config = replace(self._setting.tracker, network="any")
        secondary = Secondary(VUE, config)
        estimate = Estimate(config, START_NS, np.zeros(6), np.eye(6))
        estimate.cov[:] = self._start_cov
        rows = position_rows(np.zeros((self.stamps_ns.size, 2)), self._sd)
        noise: OwnNoise | None = None
        shares = []
        for k, stamp in enumerate(self.stamps_ns.tolist()):
            epoch = rows[2 * k : 2 * k + 2].copy()
            estimate.step(stamp, 0.0, 0, epoch, NO_BIAS)
            noise = secondary.after(noise, stamp, estimate, epoch, NO_BIAS)
            shares.append(secondary.track(noise, 0, estimate, NO_BIAS).own_cov)
        return np.array(shares)


class Stages:
    """All stages of a setting: everything that no seed changes."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self.networks = [Pass(setting, [network]) for network in setting.networks]
        self.central = Pass(setting, setting.networks)
        self.stamps_ns = common_stamps_ns(setting)
        self.time_s = (self.stamps_ns - START_NS) / NS
        self._moves = [self._to_common(p.stamps_ns) for p in (*self.networks, self.central)]
        self.covs: dict[str, Array] = {}
        """Covariance of the position (n, 2, 2) by estimator."""
        self._gains: dict[str, tuple[Array, Array]] = {}
        self._prepare()

    def _to_common(self, stamps_ns: Ints) -> tuple[Ints, Array]:
        """Index of the newest estimate at each common instant, and F (n, 6, 6) from it."""
        newest = np.searchsorted(stamps_ns, self.stamps_ns, side="right") - 1
        jerk = self.setting.tracker.jerk_density
        F = [
            step_matrices(int(t - s), jerk)[0]
            for t, s in zip(self.stamps_ns, stamps_ns[newest], strict=True)
        ]
        return newest, np.array(F)

    def _prepare(self) -> None:
        jerk = self.setting.tracker.jerk_density
        tracks = []
        for number, network in enumerate((*self.networks, self.central)):
            covs = network.run(np.zeros((network.stamps_ns.size, 2)), np.zeros(6))[1]
            name = CENTRAL
            own_covs = np.zeros_like(covs)
            if number < 2:
                name, own_covs = self.setting.networks[number].name, network.own_covs()
            newest = self._moves[number][0]
            moved = [
                at_common_instant(
                    [
                        NetworkTrack(
                            stamp_ns=int(network.stamps_ns[i]),
                            network=name,
                            vue_id=VUE,
                            mean=np.zeros(6),
                            cov=covs[i],
                            own_cov=own_covs[i],
                        )
                    ],
                    int(stamp),
                    jerk,
                )
                for i, stamp in zip(newest, self.stamps_ns, strict=True)
            ]
            tracks.append([(m.cov[0], m.own_cov[0]) for m in moved])
            self.covs[name] = np.array([m.cov[0, POSITION, POSITION] for m in moved])
        for method in METHODS:
            pairs = [
                fuse_pair(cov_a, own_a, cov_b, own_b, method)
                for (cov_a, own_a), (cov_b, own_b) in zip(*tracks[:2], strict=True)
            ]
            self.covs[method] = np.array([pair.cov[POSITION, POSITION] for pair in pairs])
            self._gains[method] = (
                np.array([pair.gain_a for pair in pairs]),
                np.array([pair.gain_b for pair in pairs]),
            )

    def errors(self, seed: int) -> dict[str, Array]:
        """Position errors (n, 2) of every estimator at the common instants."""
        setting = self.setting
        truth = {p: setting.truth(seed, p.stamps_ns) for p in (*self.networks, self.central)}
        common = setting.truth(seed, self.stamps_ns)
        start = setting.truth(seed, np.array([START_NS]))[0]
        shared = generator(seed, "start").standard_normal(6) * np.sqrt(setting.start_var)
        moved = []
        for p, (newest, F) in zip((*self.networks, self.central), self._moves, strict=True):
            means = p.run(p.fixes(seed, truth[p]), start + shared)[0]
            moved.append(np.einsum("nij,nj->ni", F, means[newest]))
        names = [network.name for network in setting.networks] + [CENTRAL]
        estimate = dict(zip(names, moved, strict=True))
        for method, (a, b) in self._gains.items():
            estimate[method] = np.einsum("nij,nj->ni", a, moved[0]) + np.einsum(
                "nij,nj->ni", b, moved[1]
            )
        return {name: mean[:, :2] - common[:, :2] for name, mean in estimate.items()}


@lru_cache(maxsize=8)
def stages_of(setting: Setting) -> Stages:
    """The stages of a setting, built once per process."""
    return Stages(setting)


def errors_of_seeds(setting: Setting, seeds: range) -> dict[str, Array]:
    """Position errors (len(seeds), n, 2) by estimator."""
    runs = [stages_of(setting).errors(seed) for seed in seeds]
    return {name: np.array([run[name] for run in runs]) for name in runs[0]}
