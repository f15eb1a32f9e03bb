"""A scenario, run with one seed: simulator, filter and bound."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from netpos.evaluation.bounds import bound_covariances
from netpos.evaluation.metrics import NS
from netpos.evaluation.reproduce.integrity import reported
from netpos.evaluation.reproduce.rows import RowTemplates, observation_rows
from netpos.filters.measurement import BIAS
from netpos.filters.motion import N_CORE, SPEED_OF_LIGHT_MPS
from netpos.messages.values import Array, ImuSample
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.simulation import Beacons
from netpos.tracking import estimates
from netpos.tracking.config import TrackerConfig
from netpos.tracking.engine import run_epochs
from netpos.tracking.imu_buffer import ImuBuffer
from netpos.tracking.models import grown, initial_extra_sd, motions_of, options_of, pose_state

Ints = npt.NDArray[np.int64]

VUE = "vue_1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A scenario with single values changed before validation, as ``load_scenario`` takes them,
    and settings of the tracker over the scenario's own.

    start_drawn: the filter starts not where the scenario says but off the truth by a draw from its
    own start covariance, as its bound takes for granted.
    """

    name: str
    scenario: str
    changes: tuple[tuple[str, object], ...] = ()
    tracker: tuple[tuple[str, object], ...] = ()
    start_drawn: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """One run: N epochs with at least one measurement, up to the loss of the track if ``lost``.

    stamps_ns (N,); truth and mean (N, n) in the filter's units; cov and bound (N, n, n); nis, dof
    (N,); level (N,) the protection level [m]
    """

    stamps_ns: Ints
    truth: Array
    mean: Array
    cov: Array
    bound: Array
    nis: Array
    dof: Array
    level: Array
    lost: bool

    @property
    def error_m(self) -> Array:
        """(N,) horizontal errors."""
        error: Array = np.hypot(*(self.mean[:, :2] - self.truth[:, :2]).T)
        return error


class Epochs(NamedTuple):
    """Epochs of a run: stamps_ns (N,), row_start (N + 1,), rows (M, ROW_WIDTH), biases (2, k) in
    the rows."""

    stamps_ns: Ints
    row_start: Ints
    rows: Array
    bias: Array


class Setup:
    """What all seeds of an experiment share."""

    def __init__(self, experiment: Experiment) -> None:
        scenario = load_scenario(experiment.scenario, changes=dict(experiment.changes))
        self.simulation = Simulation(scenario)
        """Under the scenario's own seed."""
        self.config = TrackerConfig.from_mapping({**scenario.tracker, **dict(experiment.tracker)})
        self._templates = RowTemplates.of(self.simulation.rsus, self.simulation.fields)
        self._options = options_of(self.config)
        self._extra_sd = initial_extra_sd(self.config)
        self._motions = motions_of(self.config)
        self._start_drawn = experiment.start_drawn

    def run(self, seed: int) -> Track:
        """Simulate, estimate and bound one seed.

        Raises
        ------
        ValueError  the scenario gives no initial pose, or no RSU hears the first beacon, or RSUs
            declare biases while the motion model is inertial
        """
        simulation = self.simulation.with_seed(seed)
        mean, cov = self._start(simulation)
        heard, epochs = self._epochs(simulation)
        prior = self._grown(mean, cov, epochs)[1]
        truth = _truth(simulation.beacons(VUE), heard, len(prior))
        if self._start_drawn:
            mean = np.random.default_rng([seed, 1]).multivariate_normal(truth[0, :N_CORE], cov)
        if self.config.use_imu:
            if epochs.bias.size:
                raise ValueError(
                    "an inertial motion model takes no RSU biases here; undeclare them"
                )
            done, *filled, motions = self._stepped(epochs, mean, cov, simulation.imu(VUE))
        elif self.config.motion_model == "interacting":
            done, *filled, _ = self._stepped(epochs, mean, cov, None)
            motions = self._motions[1:2]  # straight on: bound and level know one model
        else:
            done, *filled = self._compiled(epochs, mean, cov)
            motions = self._motions
        height_m, risk = self.config.device_height_m, self.config.integrity_risk
        bound = bound_covariances(*epochs[:3], truth, prior, height_m, motions, epochs.bias)
        means, covs, nis, dof, taken = (array[:done] for array in filled)
        means, covs, level = reported(
            *epochs[:3], means, covs, nis, dof, taken, motions, epochs.bias, self._options, risk
        )
        return Track(
            stamps_ns=epochs.stamps_ns[:done],
            truth=truth[:done],
            mean=means,
            cov=covs,
            bound=bound[:done],
            nis=nis,
            dof=dof,
            level=level,
            lost=done < heard.size,
        )

    def _start(self, simulation: Simulation) -> tuple[Array, Array]:
        """Mean and covariance of the initial pose."""
        pose = simulation.initial_pose(VUE)
        if pose is None:
            raise ValueError(
                f"scenario {simulation.scenario.name} gives no initial pose; set initial_pose_sd_m"
            )
        return pose_state(self.config, pose.position[:2], pose.cov[:2, :2])

    def _epochs(self, simulation: Simulation) -> tuple[Ints, Epochs]:
        """The beacons heard, (N,), and their epochs."""
        heard, row_start, rows, bias = observation_rows(
            simulation.observations(VUE), self._templates, N_CORE + self._extra_sd.size
        )
        if not heard.size or heard[0] > 0:
            raise ValueError(f"no RSU hears the first beacon of {simulation.scenario.name}")
        stamps_ns = simulation.beacons(VUE).stamp_ns[heard]
        return heard, Epochs(stamps_ns, row_start, rows, bias)

    def _compiled(
        self, epochs: Epochs, mean: Array, cov: Array
    ) -> tuple[int, Array, Array, Array, Array, Array]:
        """Epochs done, means, covariances, NIS, degrees of freedom, accepted groups: all epochs in
        one kernel."""
        mean, cov = self._grown(mean, cov, epochs)
        filled = _room(epochs.stamps_ns.size, mean.size)
        motion = self._motions[0]
        done = run_epochs(*epochs[:3], mean, cov, motion, epochs.bias, self._options, *filled)
        return done, *filled

    def _grown(self, mean: Array, cov: Array, epochs: Epochs) -> tuple[Array, Array]:
        """The start with the motion model's own states and the biases."""
        return grown(mean, cov, np.append(self._extra_sd, epochs.bias[0]))

    def _stepped(
        self, epochs: Epochs, mean: Array, cov: Array, samples: list[ImuSample] | None
    ) -> tuple[int, Array, Array, Array, Array, Array, Array]:
        """As ``_compiled``, epoch by epoch; also the motions (N, Parameter). The IMU's samples
        drive the filter between them (None: no IMU). A slow error becomes a state when it is first
        heard of, as in a tracker: until then it is in the results only."""
        imu = ImuBuffer()
        for sample in samples or ():
            imu.add(sample)
        count, config = epochs.stamps_ns.size, self.config
        sd, first = np.append(self._extra_sd, epochs.bias[0]), N_CORE + self._extra_sd.size
        mean, cov = grown(mean, cov, self._extra_sd)
        filled = _room(count, N_CORE + sd.size)
        means, covs, nis, dof, groups = filled
        motions = np.tile(self._motions[0], (count, 1))
        heard_ns = int(epochs.stamps_ns[0])
        estimate = estimates.start(config, heard_ns, mean, cov)
        rejected, known = 0, first
        for k, stamp in enumerate(epochs.stamps_ns.tolist()):
            rows = epochs.rows[epochs.row_start[k] : epochs.row_start[k + 1]].copy()
            known = max(known, int(rows[:, BIAS].max()) + 1)
            estimate.grow(sd[: known - N_CORE])
            if samples is not None:
                yaw, speed, _ = imu.increments(estimate.stamp_ns, stamp)
                estimate.drive(yaw, speed, config.gyro_noise_density)
            unheard_s, bias = (stamp - heard_ns) / NS, epochs.bias[:, : known - first].copy()
            nis[k], dof[k], taken = estimate.step(stamp, unheard_s, rejected, rows, bias)
            means[k], covs[k] = grown(estimate.mean, estimate.cov, sd)
            groups[k] = taken.sum()
            if samples is not None:
                motions[k] = estimate.motion
            rejected = 0 if 2 * taken.sum() >= taken.size else rejected + 1
            heard_ns = stamp if dof[k] else heard_ns
            if rejected >= config.max_rejected_epochs:
                return k + 1, *filled, motions
        return count, *filled, motions


def _room(epochs: int, n: int) -> tuple[Array, Array, Array, Array, Array]:
    """Means, covariances, NIS, degrees of freedom and accepted groups, to be filled."""
    figures = np.empty((3, epochs))
    return np.empty((epochs, n)), np.empty((epochs, n, n)), figures[0], figures[1], figures[2]


def _truth(beacons: Beacons, heard: Ints, n: int) -> Array:
    """(N, n) true states of the beacons ``heard`` (N,); entries beyond the six are 0."""
    c = SPEED_OF_LIGHT_MPS
    truth = np.zeros((heard.size, n))
    truth[:, :2] = beacons.position[heard, :2]
    truth[:, 2:4] = beacons.velocity[heard]
    truth[:, 4] = c * beacons.clock_offset_s[heard]
    truth[:, 5] = c * beacons.clock_drift[heard]
    return truth


@lru_cache(maxsize=4)
def setup_of(experiment: Experiment) -> Setup:
    """The set-up of an experiment, built once per process."""
    return Setup(experiment)
