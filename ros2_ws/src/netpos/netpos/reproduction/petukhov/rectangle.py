"""petukhov's walk round the rectangle: one seed through simulator and tracker.

Radio is that of the scenario ``pedestrian_rectangle``; the person walks at constant speed in
steps, as the paper has it, and dead reckoning is its error model (``steps``). A step's velocity is
known during the step, which no system has that must first see the step end: ``waist_chain`` is the
walk as a system hears it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from netpos.estimation.densities import Density, held
from netpos.estimation.fixes.phase_fix import TWO_PI, init_hypothesis
from netpos.estimation.measurement import GROUP, VALUE, predict_row
from netpos.estimation.motion import NO_BIAS
from netpos.estimation.state import POSITION
from netpos.messages.values import Array
from netpos.radio.noise import generator
from netpos.reproduction.experiment import VUE
from netpos.reproduction.petukhov.steps import (
    StepErrors,
    reported,
    steps_of,
    velocity_rows,
)
from netpos.reproduction.petukhov.troubles import NO_TROUBLE, Trouble, within
from netpos.reproduction.petukhov.waist_chain import Settings, config_of
from netpos.reproduction.rows import RowTemplates, observation_rows
from netpos.scenario import Simulation, load_scenario
from netpos.scenario.schema import RectangleRoute
from netpos.tracking.config import TrackerConfig
from netpos.tracking.estimators.adaptive_process_noise import AdaptiveProcessNoise
from netpos.tracking.estimators.estimates import Estimate
from netpos.tracking.first_fix.phase_start import PhaseStart

Ints = npt.NDArray[np.int64]

NS = 1_000_000_000
SPEED_MPS, STEP_M, PAUSE_S = 1.0, 0.6375, 1.02
WALKED_M, STEPS, DURATION_S = 20.4, 32, 25.5
ERRORS = StepErrors()
_DEVICE = {
    "route": {
        "kind": "rectangle",
        "corner": [-2.85, 1.5],
        "width_m": 5.7,
        "height_m": 4.5,
        "pauses_s": [PAUSE_S] * 5,
    },
    "speed_mps": SPEED_MPS,
    "antenna_height_m": 1.0,
    "beacon_interval_s": 0.1,
}
_BASELINE = "rsus.units.0.antennas.baseline_wavelengths"


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A way to walk the rectangle: baseline, settings of the tracker over the scenario's own or,
    with ``defaults``, over the library's, when the anchor is hidden (from, to) [s], and what else
    goes wrong."""

    name: str
    wavelengths: float
    tracker: Settings = ()
    defaults: bool = False
    hidden_s: tuple[float, float] | None = None
    trouble: Trouble = NO_TROUBLE


@dataclass(frozen=True, slots=True)
class Walked:
    """One run: times_s (n,), truth (n, 2) m, and from the first fix on (NaN before) mean (n, 6),
    cov (n, 6, 6); whether the sector was decided (n,); nis and its
    degrees of freedom (n,)."""

    times_s: Array
    truth: Array
    mean: Array
    cov: Array
    decided: npt.NDArray[np.bool_]
    nis: Array
    dof: Array

    @property
    def error_m(self) -> Array:
        """(n,) horizontal errors; NaN where there is no estimate or it is not decided."""
        error = np.hypot(*(self.mean[:, POSITION] - self.truth).T)
        return np.where(self.decided, error, np.nan)


class Setup:
    """Set-up that all seeds of a case share."""

    def __init__(self, case: Case) -> None:
        changes = {"devices.0": _DEVICE, _BASELINE: case.wavelengths}
        scenario = load_scenario("pedestrian_rectangle", changes=changes)
        self.simulation = Simulation(scenario)
        self.config = config_of(scenario, case.tracker, case.defaults)
        self._case = case
        self._templates = RowTemplates.of(self.simulation.rsus, self.simulation.fields)
        beacons = self.simulation.beacons(VUE)
        self.stamps_ns = beacons.stamp_ns
        self.times_s = (beacons.stamp_ns - beacons.stamp_ns[0]) / NS
        self.truth: Array = beacons.position[:, :2]
        route = scenario.devices[0].route
        assert isinstance(route, RectangleRoute)
        points = route.waypoints(generator(0, ""))
        self.steps = steps_of(points, np.array(route.pauses_s), SPEED_MPS, STEP_M)
        self.heard = case.trouble.heard(self.times_s)
        if case.hidden_s is not None:
            self.heard &= ~within(self.times_s, case.hidden_s)

    def rows(self, seed: int) -> Array:
        """Rows (n, 4, ROW_WIDTH) of all epochs: range and phase, then velocity."""
        seen = self.simulation.with_seed(seed).observations(VUE)
        _, _, radio, _ = observation_rows(seen, self._templates, first_bias=6)
        rng = generator(seed, f"{VUE}/steps")
        tau_s = self.config.velocity_correlation_s
        trouble = self._case.trouble
        velocity, _ = velocity_rows(self.times_s, self.steps, trouble.errors, rng, tau_s)
        radio = radio.reshape(len(velocity), 2, -1)
        trouble.spoil(self.times_s, radio, generator(seed, f"{VUE}/trouble"))
        return np.concatenate([radio, velocity], axis=1)

    def run(self, seed: int) -> Walked:
        """Simulate and estimate one seed."""
        rows, n = self.rows(seed), len(self.times_s)
        mean, cov = np.full((n, 6), np.nan), np.full((n, 6, 6), np.nan)
        decided, nis, dof = np.zeros(n, dtype=bool), np.zeros(n), np.zeros(n)
        start, estimate, rejected, last_ns = PhaseStart(self.config), None, 0, 0
        process_noise = AdaptiveProcessNoise(self.config)
        wrong_s = self._case.trouble.wrong_s
        wrong_at = -1 if wrong_s is None else int(np.searchsorted(self.times_s, wrong_s))
        for k, stamp in enumerate(self.stamps_ns.tolist()):
            epoch_rows = rows[k] if self.heard[k] else _alone(rows[k, 2:])
            velocity = reported(stamp, epoch_rows[-2:])
            free = held(self.config.accel_density_mps2_sqrthz, Density.ACCEL)
            density = process_noise.density(stamp, free, [velocity])
            if estimate is None:
                start.hear(velocity)
                estimate = start.add(stamp, epoch_rows, np.zeros(len(epoch_rows)))
            else:
                estimate.set_process_noise(density)
                if k == wrong_at:
                    estimate = _moved(self.config, estimate, epoch_rows)
                unheard_s = (stamp - last_ns) / NS
                step = estimate.step(stamp, unheard_s, rejected, epoch_rows, NO_BIAS)
                nis[k], dof[k] = step.nis, step.dof
                # group 0 is the anchor's where it is heard
                rejected = 0 if step.accepted[0] else rejected + 1
                if rejected >= self.config.max_rejected_epochs:
                    start, estimate, rejected = PhaseStart(self.config), None, 0
            last_ns = stamp
            if estimate is not None:
                mean[k], cov[k], decided[k] = estimate.mean, estimate.cov, not estimate.modes
        return Walked(self.times_s, self.truth, mean, cov, decided, nis, dof)


def _moved(config: TrackerConfig, estimate: Estimate, rows: Array) -> Estimate:
    """The same estimate, sure of the sector beside its own, towards boresight."""
    mean, cov, phase = estimate.mean.copy(), estimate.cov.copy(), rows[1]
    speed, height_m = config.initial_speed_sd_mps, config.device_height_m
    excess = predict_row(phase, mean, height_m, np.zeros(mean.size)) - phase[VALUE]
    turns = round(excess / TWO_PI)
    moving = slice(2, 4)
    velocity, velocity_cov = mean[moving].copy(), cov[moving, moving].copy()
    init_hypothesis(mean, cov, rows[0], phase, turns + (1 if turns <= 0 else -1), speed, height_m)
    mean[moving], cov[moving, moving] = velocity, velocity_cov
    return Estimate(config, estimate.stamp_ns, mean, cov)


def _alone(rows: Array) -> Array:
    """Velocity rows without the anchor's."""
    alone = rows.copy()
    alone[:, GROUP] = 0
    return alone


@lru_cache(maxsize=8)
def setup_of(case: Case) -> Setup:
    """The set-up of a case, built once per process."""
    return Setup(case)
