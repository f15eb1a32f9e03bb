"""A scenario, run with one seed: simulator, filter and bound."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from netpos.estimation.measurement import BIAS, HEIGHT, SAME_BEND, SAME_BEND_S
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.estimation.state import N_CORE, POSITION, VELOCITY, HeightState, X
from netpos.evaluation.bounds import bound_covariances
from netpos.messages.values import Array
from netpos.reproduction.paper_filter import follow_paper
from netpos.reproduction.rows import RowTemplates, observation_rows
from netpos.reproduction.segments import Epochs, Flags, Followed, Follower, Ints
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.simulation import Beacons
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.models import height_state, pose_state
from netpos.tracking.rsus.rsu import Rsu, values_as_one

VUE = "vue_1"

Estimator = Literal["scenario", "defaults", "paper"]

FACTS = (
    "require_initial_pose",
    "device_height_m",
    "device_height_sd_m",
    "device_height_time_s",
    "motion_model",
)
"""Parameters of the tracker that are no tuning: what a user knows of the device and its start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A scenario with single values changed before validation, as ``load_scenario`` takes them,
    and settings of the tracker over the scenario's own.

    start_drawn: the filter starts not where the scenario says but off the truth by a draw from its
    own start covariance, as its bound takes for granted.
    estimator: scenario, our tracker with the settings of the scenario; defaults, our tracker with
    the library's defaults but for ``FACTS``; paper, the filter of ``paper_filter``.
    """

    name: str
    scenario: str
    changes: tuple[tuple[str, object], ...] = ()
    tracker: tuple[tuple[str, object], ...] = ()
    start_drawn: bool = False
    estimator: Estimator = "scenario"


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """One run: N epochs with at least one measurement.

    stamps_ns (N,); truth and mean (N, n) in the filter's units; cov and bound (N, n, n); nis, dof
    (N,); level (N,) the protection level [m]; tracked (N,), elsewhere mean, cov and level are NaN;
    losses: how often the track was lost
    """

    stamps_ns: Ints
    truth: Array
    mean: Array
    cov: Array
    bound: Array
    nis: Array
    dof: Array
    level: Array
    tracked: Flags
    losses: int

    @property
    def error_m(self) -> Array:
        """(N,) horizontal errors; NaN while there is no track."""
        error: Array = np.hypot(*(self.mean[:, POSITION] - self.truth[:, POSITION]).T)
        return error


class Setup:
    """What all seeds of an experiment share."""

    def __init__(self, experiment: Experiment) -> None:
        scenario = load_scenario(experiment.scenario, changes=dict(experiment.changes))
        self.simulation = Simulation(scenario)
        """Under the scenario's own seed."""
        settings = {**scenario.tracker, **dict(experiment.tracker)}
        if experiment.estimator == "defaults":
            settings = {name: settings[name] for name in FACTS if name in settings}
        self.config = TrackerConfig.from_mapping(settings)
        rsus = self.simulation.rsus
        self._templates = RowTemplates.of(rsus, self.simulation.fields)
        self._follower = Follower(self.config, tuple(Rsu.of(info) for info in rsus))
        self._experiment = experiment
        self._height = height_state(self.config)

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
        prior = self._follower.augmented(mean, cov, epochs.bias)[1]
        truth = _truth(simulation.beacons(VUE), heard, len(prior), self._height)
        if self._experiment.start_drawn:
            mean = np.random.default_rng([seed, 1]).multivariate_normal(truth[0, :N_CORE], cov)
        followed = self._followed(simulation, epochs, mean, cov, truth)
        height_m = self.config.device_height_m
        bound = bound_covariances(
            *epochs[:3], truth, prior, height_m, followed.motions, epochs.bias
        )
        return Track(
            stamps_ns=epochs.stamps_ns,
            truth=truth,
            mean=followed.means,
            cov=followed.covs,
            bound=bound,
            nis=followed.nis,
            dof=followed.dof,
            level=followed.level,
            tracked=followed.tracked,
            losses=followed.losses,
        )

    def _followed(
        self, simulation: Simulation, epochs: Epochs, mean: Array, cov: Array, truth: Array
    ) -> Followed:
        """What the estimator makes of the epochs of a run."""
        if self._experiment.estimator == "paper":
            return follow_paper(self.config, epochs, mean, cov, truth)
        if not self.config.use_imu:
            return self._follower.follow(epochs, mean, cov, None)
        if epochs.bias.size:
            raise ValueError("an inertial motion model takes no RSU biases here; undeclare them")
        return self._follower.follow(epochs, mean, cov, simulation.imu(VUE))

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
        seen = simulation.observations(VUE)
        own = self._follower.own_slow
        heard, row_start, rows, bias = observation_rows(
            seen, self._templates, self._follower.first_bias + own.shape[1]
        )
        rows[:, HEIGHT] = self._height.entry
        bias = np.hstack([own, bias])
        if not heard.size or heard[0] > 0:
            raise ValueError(f"no RSU hears the first beacon of {simulation.scenario.name}")
        stamps_ns = simulation.beacons(VUE).stamp_ns[heard]
        _note_same_bends(rows, np.repeat(stamps_ns, np.diff(row_start)))
        return heard, Epochs(stamps_ns, row_start, rows, bias, seen.rsu[heard])


def _note_same_bends(rows: Array, stamps_ns: Ints) -> None:
    """Write to ``rows`` (M, ROW_WIDTH), made at ``stamps_ns`` (M,), how many more values of their
    slow error have the same bend."""
    order = np.argsort(rows[:, BIAS], kind="stable")
    order = order[rows[order, BIAS] >= 0.0]
    since_s = np.diff(stamps_ns[order]) * 1e-9
    again = np.diff(rows[order, BIAS]) == 0.0
    values = [values_as_one(SAME_BEND_S, s) for s in since_s[again].tolist()]
    rows[order[1:][again], SAME_BEND] = np.array(values) - 1.0


def _truth(beacons: Beacons, heard: Ints, n: int, height: HeightState) -> Array:
    """(N, n) true states of the beacons ``heard`` (N,); of entries beyond the six there is only
    the height."""
    c = SPEED_OF_LIGHT_MPS
    truth = np.zeros((heard.size, n))
    truth[:, POSITION] = beacons.position[heard, :2]
    truth[:, VELOCITY] = beacons.velocity[heard]
    truth[:, X.CLOCK] = c * beacons.clock_offset_s[heard]
    truth[:, X.DRIFT] = c * beacons.clock_drift[heard]
    if height.entry:
        truth[:, height.entry] = beacons.position[heard, 2] - height.nominal_m
    return truth


@lru_cache(maxsize=8)
def setup_of(experiment: Experiment) -> Setup:
    """The set-up of an experiment, built once per process."""
    return Setup(experiment)
