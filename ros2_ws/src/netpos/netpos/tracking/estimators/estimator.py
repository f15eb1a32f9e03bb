"""What a track needs of its estimator: the interface that planar and spatial tracks differ behind.

``Track`` keeps the order of epochs, what is refused and why, the health of the RSUs, the rule for
a lost track and the report. An ``Estimator`` keeps the state of the device: it turns measurements
into rows, finds a first fix, predicts, updates and describes. ``planar.PlanarEstimator`` has the
filters of ``estimates``, ``spatial.SpatialEstimator`` the strapdown filter.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.rows import couple
from netpos.estimation.state import POSITION
from netpos.messages.values import (
    Array,
    ClockState,
    InitialPose,
    NetworkTrack,
    Odometry,
    RsuErrors,
    RsuMeasurement,
    StepCalibration,
    TrackMode,
)
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.epoch_rows import (
    EpochRows,
    RowForm,
    Source,
    epoch_rows_of,
    reference_of,
    widen,
)
from netpos.tracking.estimators.estimates import UpdateResult
from netpos.tracking.estimators.imu_buffer import ImuBuffer
from netpos.tracking.estimators.models import pose_state
from netpos.tracking.first_fix.initialise import Initialiser
from netpos.tracking.rsus.rsu import BiasStates, Rsu

_POSE_SD_MIN_M = 1.0  # an initial pose is no surer than this when it is weighed

RECENT = 5
"""So many epochs weigh an initial pose."""
Recent = tuple[tuple[int, EpochRows], ...]
"""Stamps and rows of the newest epochs that fitted, oldest first."""


class Past(NamedTuple):
    """What came before an epoch: seconds since the last accepted measurement, and epochs in a row
    that did not fit."""

    unheard_s: float
    rejected_in_row: int


class FirstFix(NamedTuple):
    """Whether there is a first fix now, and whether it knows the clock. ``refused``: why the
    measurements of the epoch count as rejected; empty: they do not."""

    found: bool
    has_clock: bool = False
    refused: str = ""


class Description(NamedTuple):
    """An estimate as others read it: odometry, clock, the sd [m] of the position along its worst
    horizontal direction, the radius [m] that its Gaussian error leaves with ``integrity_risk``."""

    odometry: Odometry
    clock: ClockState
    position_sd_m: float
    radius_m: float


class AnyEstimate(Protocol):
    """What planar and spatial estimates have alike."""

    stamp_ns: int


class Estimator(ABC):
    """The state of one device. Calls come in the order of stamps.

    What serves only one kind of track has a default here that does nothing:

    - Several modes, mixtures and undetected manoeuvres are planar: an IMU shows every manoeuvre,
      and the error-state filter is one Gaussian.
    - ``learn`` is planar: it tells the bias of an RSU from the error of a position by the rows of
      one second, in which the errors of an IMU are not separated yet (decision 0077).
    - Step velocities and their calibration are planar: who has strapdown navigation needs none.
    - ``network_track`` is planar: the fusion of networks takes tracks of one height.
    - Fixed-lag smoothing is planar: a spatial track is smoothed afterwards, over its whole length.
    """

    imu: ImuBuffer
    """The samples of the device; they stay when the estimate is forgotten."""
    estimate: AnyEstimate | None
    """None before the first fix."""
    biases: BiasStates
    """States for the slow errors of RSUs."""
    recorder: Any = None
    """Where posteriors are kept for a smoother; None: nowhere."""
    bias: Array
    """(2, k) standard deviation and correlation time of these states."""

    def __init__(
        self, vue_id: str, config: TrackerConfig, rsus: Mapping[str, Rsu], form: RowForm
    ) -> None:
        self._vue_id, self._config = vue_id, config
        self.imu = ImuBuffer()
        self._rsus, self._form = rsus, form
        self.bias = np.zeros((2, 0))

    def set_config(self, config: TrackerConfig) -> None:
        """Go on with other live parameters; a first fix under way keeps those it began with."""
        self._config = config

    @property
    @abstractmethod
    def missing(self) -> str:
        """What a first fix lacks, for people."""

    @abstractmethod
    def _forget(self) -> None:
        """Become an estimator that has heard nothing."""

    def fresh(self) -> Self:
        """One without an estimate, of the same device."""
        twin = copy.copy(self)
        twin._forget()
        return twin

    def copy(self) -> Self:
        """An independent copy, to go back to; samples and what is kept for a smoother are
        shared."""
        twin = copy.copy(self)
        twin.biases = self.biases.copy()
        return twin

    def ahead(self, stamp_ns: int) -> Self:
        """A copy that is at ``stamp_ns`` and keeps nothing for a smoother."""
        twin = self.copy()
        twin.recorder = None
        twin.predict(stamp_ns)
        return twin

    # measurements

    def readable(self, item: Source) -> Source | None:
        """What of a measurement there are rows for; None: nothing."""
        return item

    def rows(self, items: Sequence[Source], inflation: Mapping[str, float]) -> EpochRows:
        """Rows of an epoch, one group for each item; slow errors of RSUs heard for the first time
        become states. ``inflation``: of the variance of velocities, by source."""
        version = self.biases.version
        rows = epoch_rows_of(items, self._rsus, self.biases, self._form, inflation)
        if self.biases.version != version:
            self.bias = self.biases.arrays()
        return rows

    def rows_alone(self, item: RsuMeasurement) -> tuple[EpochRows, Array]:
        """Rows of one measurement without states for its RSU's biases, and its innovations at the
        estimate with their sd, which holds these biases (m, 2). A share by which all distances are
        too long is taken out."""
        rows, rsu = epoch_rows_of([item], self._rsus, None, self._form), self._rsus[item.rsu_id]
        couple(rows.rows, self.biases.stretches(rsu, item))
        innovations = self.innovations(rows.rows)
        widen(innovations, rows.rows, rsu, reference_of(item, self._rsus))
        return rows, innovations

    def heard(self, epoch_rows: EpochRows) -> tuple[Rsu, ...]:
        """The RSUs of an epoch."""
        return tuple(
            self._rsus[i.rsu_id] for i in epoch_rows.items if isinstance(i, RsuMeasurement)
        )

    @abstractmethod
    def innovations(self, rows: Array) -> Array:
        """Innovations of ``rows`` (m, ROW_WIDTH) at the estimate, and their sd (m, 2)."""

    # first fix

    @abstractmethod
    def pose_cost(self, stamp_ns: int, pose: InitialPose, recent: Recent | None) -> float:
        """How much worse the ``recent`` epochs (None: those collected for a first fix) fit where
        the device is at ``pose`` than where they fit best: chi-square with 2 degrees of freedom
        for the true pose."""

    def _collect(self, window: Initialiser, stamp_ns: int, epoch_rows: EpochRows) -> None:
        """Give ``window`` the rows of an epoch, of planar form."""
        window.add(stamp_ns, epoch_rows.rows, self.heard(epoch_rows))

    def _excess_cost(self, window: Initialiser, stamp_ns: int, pose: InitialPose) -> float:
        """``Initialiser.excess_cost`` of a pose, however sure it is of itself."""
        mean, cov = pose_state(self._config, pose.position[:2], pose.cov[:2, :2])
        var = np.diag(cov).copy()
        var[POSITION] = np.maximum(var[POSITION], _POSE_SD_MIN_M**2)
        return window.excess_cost(stamp_ns, mean, var, self.biases.slow_errors)

    @abstractmethod
    def start_from_pose(self, stamp_ns: int, pose: InitialPose) -> bool:
        """Take a pose for the start; whether there is an estimate now."""

    @abstractmethod
    def first_fix(self, stamp_ns: int, epoch_rows: EpochRows) -> FirstFix:
        """Collect the rows of an epoch until they determine an estimate."""

    # estimate

    @abstractmethod
    def predict(self, stamp_ns: int) -> None:
        """Move the estimate to ``stamp_ns``; nothing happens to one that is there already."""

    @abstractmethod
    def update(self, stamp_ns: int, epoch_rows: EpochRows, past: Past) -> UpdateResult:
        """Move the estimate to ``stamp_ns``, gate the groups of rows and fuse those that pass."""

    def learn(
        self, stamp_ns: int, rows: Array, accepted: Sequence[float]
    ) -> tuple[RsuErrors, ...]:
        """Learn the errors of the RSUs from an epoch; what was concluded."""
        return ()

    @property
    def modes(self) -> tuple[TrackMode, ...]:
        """Where the device may be while that is not decided; none where it is."""
        return ()

    @property
    def is_at_a_place(self) -> bool:
        """Whether the device can be where the estimate is; not where that is the mean of a ring or
        of two places."""
        return True

    @property
    def components(self) -> Mixture | None:
        """What the estimate is made of, over the states of ``estimation.state``; None where it is
        one Gaussian of errors (spatial)."""
        return None

    def radius(self, level_m: float) -> float:
        """Radius [m] that holds ``level_m`` and all other places where the device may be."""
        return level_m

    # output

    @abstractmethod
    def describe(self, stamp_ns: int) -> Description:
        """The estimate, which is at ``stamp_ns``. Raises ``ValueError`` where the covariance of
        the position is none."""

    def step_calibration(self) -> StepCalibration | None:
        """What is known of the steps of a person; None where it is not estimated."""
        return None

    def network_track(self, segment: int) -> NetworkTrack | None:
        """The track for others to fuse with their own; None where no network is configured."""
        return None

    # smoothing

    @abstractmethod
    def keep_posteriors(self) -> None:
        """Keep what ``smoothed`` needs from now on: the memory of a whole recording."""

    @abstractmethod
    def record(self, segment: int) -> tuple[Odometry, ...]:
        """Keep the posterior of an epoch for the smoother; the odometry of earlier epochs that is
        now final. No smoother reaches across different ``segment`` numbers."""

    @abstractmethod
    def go_back(self, stamp_ns: int) -> None:
        """Forget what was kept for a smoother from ``stamp_ns`` on: these epochs come again."""

    @abstractmethod
    def smoothed(self) -> list[Odometry]:
        """Odometry of all epochs kept, given all measurements."""
