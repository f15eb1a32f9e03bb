"""How often the right sector is found after a few steps from a random start in a random direction:
the tracker's hypotheses beside the rule of petukhov:eq.16-18."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from netpos.estimation.densities import Density, held
from netpos.estimation.measurement import GATE_VARIANCE, VALUE, VARIANCE
from netpos.estimation.mixture.sectors import turns_of
from netpos.estimation.motion import NO_BIAS
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.evaluation.work import Work
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from netpos.radio.anchor import uwb_wavelength_m
from netpos.radio.noise import generator
from netpos.reproduction.petukhov.steps import (
    StepErrors,
    Steps,
    reported,
    reported_velocity,
    velocity_rows,
)
from netpos.reproduction.petukhov.waist_chain import SCENARIO, config_of
from netpos.scenario import load_scenario
from netpos.tracking.estimators.adaptive_process_noise import AdaptiveProcessNoise
from netpos.tracking.estimators.estimates import Estimate
from netpos.tracking.first_fix.phase_start import PhaseStart
from netpos.tracking.first_fix.step_heading import choose_sector
from netpos.world.frames import quaternion_from_yaw

Bools = npt.NDArray[np.bool_]

STEPS = 5
STEP_S, STEP_M, INTERVAL_S, NS = 0.6375, 0.6375, 0.1, 1_000_000_000
AREA_M = ((-3.85, 0.5), (3.85, 7.0))
"""Corners of where walks start and end: the rectangle and a metre around it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """An anchor, and how well range, phase and steps are measured; ``defaults``: the tracker has
    the library's parameters and the device's height, not the scenario's."""

    wavelengths: float = 4.0
    phase_sd_deg: float = 6.0
    range_sd_m: float = 0.03
    heading_sd_deg: float = 3.0
    defaults: bool = False

    @property
    def name(self) -> str:
        """For tables and progress."""
        name = f"L = {self.wavelengths:g} lambda, phase sd {self.phase_sd_deg:g} deg"
        return f"{name}, defaults" if self.defaults else name


@dataclass(frozen=True, slots=True)
class SectorShares:
    """Of many starts, after each of the first steps: the most probable sector is the right one,
    it is decided, its probability (runs, STEPS); and the paper's rule on that step alone."""

    right: Bools
    decided: Bools
    claimed: Array
    rule_right: Bools

    def share_right(self, step: int) -> float:
        """Share of starts whose most probable sector is right after so many steps."""
        return float(self.right[:, step - 1].mean())

    def share_decided(self, step: int) -> float:
        """Share of starts decided after so many steps."""
        return float(self.decided[:, step - 1].mean())

    def share_wrong(self, step: int) -> float:
        """Share of starts decided wrongly after so many steps."""
        return float((self.decided & ~self.right)[:, step - 1].mean())

    @property
    def rule_share(self) -> float:
        """Share of steps on which the paper's rule is right."""
        return float(self.rule_right.mean())


class Setup:
    """Set-up that all starts under the same conditions share."""

    def __init__(self, conditions: Conditions) -> None:
        wavelength_m = uwb_wavelength_m(5)
        self.conditions = conditions
        self.errors = StepErrors(heading_sd_rad=math.radians(conditions.heading_sd_deg))
        self.config = config_of(load_scenario(SCENARIO), (), conditions.defaults)
        self.info = RsuInfo(
            rsu_id="anchor",
            position=np.array([0.0, 0.0, self.config.device_height_m]),
            quaternion=quaternion_from_yaw(math.pi / 2),
            baseline_m=conditions.wavelengths * wavelength_m,
            wavelength_m=wavelength_m,
        )
        empty = RsuMeasurement(
            stamp_ns=1, rsu_id="anchor", vue_id="", fields=Field.RANGE | Field.PHASE
        )
        self._template = rsu_rows(empty, self.info, rsu_axes(self.info), 0)
        sds = [conditions.range_sd_m, math.radians(conditions.phase_sd_deg)]
        self._template[:, VARIANCE] = self._template[:, GATE_VARIANCE] = np.square(sds)
        count = math.ceil(STEPS * STEP_S / INTERVAL_S)
        self.times_s: Array = INTERVAL_S * np.arange(count, dtype=np.float64)

    def measured(
        self, rng: np.random.Generator, places: Array
    ) -> tuple[Array, npt.NDArray[np.int64]]:
        """Rows (n, 2, ROW_WIDTH) at positions (n, 2), and the true turns of each phase (n,)."""
        conditions = self.conditions
        noise = rng.standard_normal((len(places), 2))
        ranges = np.hypot(places[:, 0] - self.info.baseline_m / 2, places[:, 1])
        sine = np.sin(np.arctan2(places[:, 0], places[:, 1]))
        phases = 2 * np.pi * conditions.wavelengths * sine
        phases += math.radians(conditions.phase_sd_deg) * noise[:, 1]
        turns = np.floor((phases + np.pi) / (2 * np.pi)).astype(np.int64)
        rows = np.tile(self._template, (len(places), 1, 1))
        rows[:, 0, VALUE] = ranges + conditions.range_sd_m * noise[:, 0]
        rows[:, 1, VALUE] = phases - 2 * np.pi * turns
        return rows, turns

    def run(self, seed: int) -> tuple[Bools, Bools, Array, Bools]:
        """One start: right, decided, claimed and rule_right (STEPS,) of ``SectorShares``."""
        rng = generator(seed, "sector_choice")
        start, heading = _start(rng)
        way = np.array([math.cos(heading), math.sin(heading)])
        places = start + self.times_s[:, None] * STEP_M / STEP_S * way
        begins = STEP_S * np.arange(STEPS, dtype=np.float64)
        steps = Steps(begins, begins + STEP_S, np.full(STEPS, STEP_M), np.full(STEPS, heading))
        velocity, step = velocity_rows(
            self.times_s, steps, self.errors, rng, self.config.velocity_correlation_s
        )
        radio, turns = self.measured(rng, places)
        rule = self._rule(radio, step, turns, velocity)
        return (*self._hypotheses(np.concatenate([radio, velocity], axis=1), step, turns), rule)

    def _hypotheses(
        self, rows: Array, step: npt.NDArray[np.int64], turns: npt.NDArray[np.int64]
    ) -> tuple[Bools, Bools, Array]:
        right, decided = np.zeros(STEPS, dtype=bool), np.zeros(STEPS, dtype=bool)
        claimed = np.zeros(STEPS)
        estimate = PhaseStart(self.config).add(NS, rows[0], np.zeros(len(rows[0])))
        assert estimate is not None
        process_noise = AdaptiveProcessNoise(self.config)
        for k in range(1, len(rows)):
            stamp_ns = NS + round(self.times_s[k] * NS)
            free = held(self.config.accel_density_mps2_sqrthz, Density.ACCEL)
            velocities = [reported(stamp_ns, rows[k, 2:])]
            estimate.set_process_noise(process_noise.density(stamp_ns, free, velocities))
            estimate.step(stamp_ns, INTERVAL_S, 0, rows[k], NO_BIAS)
            s = int(step[k])  # the last epoch of the step stays
            probable, claimed[s] = self._sector(estimate, rows[k, 1])
            right[s], decided[s] = probable == turns[k], not estimate.modes
        return right, decided, claimed

    def _sector(self, estimate: Estimate, phase: Array) -> tuple[int, float]:
        """Turns of the most probable sector of a phase row, and its probability."""
        means, _, log_weights = estimate.components
        turns, place = np.unique(
            turns_of(means, phase, self.config.device_height_m), return_inverse=True
        )
        weights = np.bincount(place, np.exp(log_weights))
        best = int(np.argmax(weights))
        return int(turns[best]), float(weights[best])

    def _rule(
        self,
        radio: Array,
        step: npt.NDArray[np.int64],
        turns: npt.NDArray[np.int64],
        velocity: Array,
    ) -> Bools:
        right = np.zeros(STEPS, dtype=bool)
        for s in range(STEPS):
            in_step = step == s
            reported = reported_velocity(velocity[in_step][0])
            choice = choose_sector(
                self.times_s[in_step],
                radio[in_step, 0, VALUE],
                radio[in_step, 1, VALUE],
                math.atan2(reported[1], reported[0]),
                self.info.baseline_m,
                self.info.wavelength_m,
            )
            right[s] = choice is not None and choice.chosen == turns[in_step][0]
        return right


def _start(rng: np.random.Generator) -> tuple[Array, float]:
    """A start and a heading whose walk stays in the area."""
    low, high = np.array(AREA_M)
    while True:
        start, heading = rng.uniform(low, high), float(rng.uniform(-math.pi, math.pi))
        end = start + STEPS * STEP_M * np.array([math.cos(heading), math.sin(heading)])
        if (end > low).all() and (end < high).all():
            return start, heading


@lru_cache(maxsize=16)
def setup_of(conditions: Conditions) -> Setup:
    """The set-up of some conditions, built once per process."""
    return Setup(conditions)


def _job(conditions: Conditions, seeds: range) -> list[tuple[Bools, Bools, Array, Bools]]:
    setup = setup_of(conditions)
    return [setup.run(seed) for seed in seeds]


def sector_choice(work: Work, conditions: Conditions) -> SectorShares:
    """All starts of ``work`` under some conditions."""
    runs = [run for part in work.over_seeds(conditions.name, _job, conditions) for run in part]
    right, decided, claimed, rule = (np.array(column) for column in zip(*runs, strict=True))
    return SectorShares(right, decided, claimed, rule)
