"""A bank of filters over the sectors of a phase difference: against the posterior on a grid, and
through the tracker with what goes wrong on a real anchor."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from netpos.filters.measurement import KIND, VALUE, VARIANCE, Kind
from netpos.filters.motion import NO_BIAS
from netpos.filters.rows import linear_rows, rsu_axes, rsu_rows
from netpos.filters.sigma import innovation_cov, regress
from netpos.messages.values import (
    Array,
    Field,
    InitialPose,
    RsuInfo,
    RsuMeasurement,
    TrackState,
    Velocity,
)
from netpos.tracking import Tracker, TrackerConfig, TrackOutput, sector_bank
from netpos.tracking.engine import GATE
from netpos.tracking.models import options_of, pose_state
from netpos.tracking.sectors import Sectors, phase_place, sectors_of
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

T0, DT_NS = 1_000_000_000, 100_000_000
WAVELENGTH, TURNS = 0.05, 4.0
SCALE = 2 * math.pi * TURNS
RANGE_SD, PHASE_SD, VELOCITY_SD = 0.03, math.radians(6.0), 0.05
NORTH = Rotation.from_euler("z", 90, degrees=True).as_quat()
INFO = RsuInfo(
    rsu_id="anchor",
    position=np.zeros(3),
    quaternion=NORTH,
    baseline_m=TURNS * WAVELENGTH,
    wavelength_m=WAVELENGTH,
)
CONFIG: dict[str, Any] = {"filter": "srukf", "initial_speed_sd_mps": 1.5, "hold_s": 0.0}


def true_values(xy: Array) -> tuple[Array, Array]:
    """Ranges and unwrapped phases of positions (n, 2), in the paper's words: x along the array,
    y ahead of it."""
    to_master = np.hypot(xy[:, 0] - INFO.baseline_m / 2, xy[:, 1])
    return to_master, SCALE * np.sin(np.arctan2(xy[:, 0], xy[:, 1]))


def wrap(phase: Array) -> Array:
    wrapped: Array = (phase + math.pi) % (2 * math.pi) - math.pi
    return wrapped


@dataclass
class Walk:
    """What is measured of a straight walk at 1 m/s."""

    start: Array
    heading_rad: float
    seconds: float
    seed: int = 0
    hidden: tuple[float, float] = (math.inf, math.inf)
    spoilt: tuple[float, float] = (math.inf, math.inf)
    position: Array = field(init=False)
    ranges: Array = field(init=False)
    phases: Array = field(init=False)
    velocities: Array = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        n = round(self.seconds * 10)
        self.velocity = np.array([math.cos(self.heading_rad), math.sin(self.heading_rad)])
        self.position = self.start + np.arange(n)[:, None] * 0.1 * self.velocity
        ranges, phases = true_values(self.position)
        self.ranges = ranges + RANGE_SD * rng.standard_normal(n)
        self.phases = wrap(phases + PHASE_SD * rng.standard_normal(n))
        self.velocities = self.velocity + VELOCITY_SD * rng.standard_normal((n, 2))

    def items(self, k: int) -> list[Any]:
        t, stamp = k / 10, T0 + k * DT_NS
        items: list[Any] = [
            Velocity(
                stamp_ns=stamp,
                vue_id="v",
                velocity=self.velocities[k],
                cov=np.eye(2) * VELOCITY_SD**2,
            )
        ]
        if not self.hidden[0] <= t < self.hidden[1]:
            off = 2.5 if self.spoilt[0] <= t < self.spoilt[1] else 0.0
            items.append(self.measured(k, off))
        return items

    def measured(self, k: int, off: float = 0.0) -> RsuMeasurement:
        return RsuMeasurement(
            stamp_ns=T0 + k * DT_NS,
            rsu_id="anchor",
            vue_id="v",
            expected=1,
            fields=Field.RANGE | Field.PHASE,
            range_m=self.ranges[k],
            range_var=RANGE_SD**2,
            phase_difference_rad=float(wrap(np.array(self.phases[k] + off))),
            phase_difference_var=PHASE_SD**2,
        )


def tracked(walk: Walk, first: list[Any] | None = None, **config: Any) -> list[TrackOutput]:
    """Outputs of a tracker, one per epoch."""
    tracker = Tracker(TrackerConfig(**(CONFIG | config)))
    tracker.add_rsu(INFO)
    for item in first or []:
        assert tracker.add(item) is None
    outputs: list[TrackOutput] = []
    for k in range(len(walk.position)):
        for item in walk.items(k):
            assert tracker.add(item) is None
        outputs += tracker.process()
    return [*outputs, *tracker.flush()]


def errors(walk: Walk, outputs: list[TrackOutput]) -> Array:
    by_stamp = {o.status.stamp_ns: o.odometry for o in outputs}
    found = [by_stamp[T0 + k * DT_NS] for k in range(len(walk.position))]
    assert all(o is not None for o in found)
    places = np.array([o.position[:2] for o in found if o is not None])
    distance: Array = np.hypot(*(places - walk.position).T)
    return distance


def grid_posterior(walk: Walk, k: int, velocity: Array) -> dict[int, float]:
    """Probability of each number of turns at epoch ``k`` for a device anywhere in front whose
    velocity is known: every place of a fine polar grid, wrapped normal phases."""
    radius = walk.ranges[k] + np.linspace(-0.12, 0.12, 25)
    sine = np.linspace(-0.9999, 0.9999, 6001)
    r, s = np.meshgrid(radius, sine, indexing="ij")
    now = np.stack([r * s, r * np.sqrt(1 - s * s)], axis=-1)
    log_p = np.log(r / np.sqrt(1 - s * s))  # area of a cell
    for i in range(k + 1):
        xy = now + (i - k) * 0.1 * velocity
        ranges, phases = true_values(xy.reshape(-1, 2))
        range_error = (walk.ranges[i] - ranges).reshape(r.shape) / RANGE_SD
        off = (walk.phases[i] - phases).reshape(r.shape)
        turned = [-0.5 * ((wrap(off) + 2 * math.pi * j) / PHASE_SD) ** 2 for j in (-1, 0, 1)]
        log_p += -0.5 * range_error**2 + logsumexp(turned, axis=0)
        log_p[xy[..., 1] <= 0.0] = -np.inf
    turns = np.round((SCALE * s - walk.phases[k]) / (2 * math.pi)).astype(int)
    weights = {int(m): float(logsumexp(log_p[turns == m])) for m in np.unique(turns)}
    total = logsumexp(list(weights.values()))
    return {m: math.exp(w - total) for m, w in weights.items()}


def rows_at(walk: Walk, k: int, velocity_sd: float) -> Array:
    rows = rsu_rows(walk.measured(k), INFO, rsu_axes(INFO), 0)
    known = linear_rows(walk.velocity, np.eye(2) * velocity_sd**2, np.eye(2, 6, k=2), 1)
    return np.vstack([rows, known])


@pytest.mark.parametrize(("seed", "heading"), [(1, 0.3), (2, 2.0), (3, 1.5), (4, -1.0)])
def test_probabilities_are_those_of_the_posterior(seed: int, heading: float) -> None:
    walk = Walk(np.array([0.8, 4.5]), heading, 0.6, seed)
    expected = {k: grid_posterior(walk, k, walk.velocity) for k in (2, 5)}
    for name in ("srukf", "ukf", "iekf"):
        config = TrackerConfig(filter=name, accel_density_mps2_sqrthz=1e-4)
        start = pose_state(config, np.zeros(2), np.eye(2))
        bank = Sectors.begin(config, T0, rows_at(walk, 0, 1e-3), 1, start)
        assert bank is not None
        middle = len(bank.probabilities) // 2
        for k in range(1, 6):
            bank.step(T0 + k * DT_NS, 0.1, 0, rows_at(walk, k, 1e-3), NO_BIAS)
            for turns in range(-4, 5) if k in expected else ():
                ours = bank.probabilities[turns + middle]
                # half a sector at each end-fire, where a Gaussian is a poor shape
                slack = 0.03 if abs(turns) < 4 else 0.1
                assert ours == pytest.approx(expected[k].get(turns, 0.0), abs=slack)
        assert bank.probabilities.sum() == pytest.approx(1.0, abs=1e-4)


def test_initialising_until_the_evidence_decides() -> None:
    walk = Walk(np.array([-1.0, 4.0]), 0.4, 3.0, seed=5)
    outputs = tracked(walk)
    states = [o.status.state for o in outputs]
    first = states.index(TrackState.TRACKING)
    assert 2 <= first <= 20
    assert set(states[:first]) == {TrackState.INITIALISING}
    assert set(states[first:]) == {TrackState.TRACKING}
    error = errors(walk, outputs)
    assert error[first:].max() < 0.15
    before, after = outputs[first - 1].status, outputs[first].status
    # a rival sector is a metre away: the level says so for as long as it is not ruled out
    assert before.protection_level_m > 0.8
    assert after.position_sd_m < 0.1 < before.position_sd_m * 2
    assert outputs[2].status.position_sd_m > 0.3
    assert outputs[-1].status.protection_level_m < 0.5
    assert all(e <= o.status.protection_level_m for e, o in zip(error, outputs, strict=True))


def test_standing_still_leaves_the_sector_open() -> None:
    walk = Walk(np.array([1.0, 3.0]), 0.0, 4.0, seed=6)
    walk.position[:] = walk.start
    ranges, phases = true_values(walk.position)
    rng = np.random.default_rng(6)
    walk.ranges = ranges + RANGE_SD * rng.standard_normal(40)
    walk.phases = wrap(phases + PHASE_SD * rng.standard_normal(40))
    walk.velocities -= walk.velocity
    outputs = tracked(walk)
    assert {o.status.state for o in outputs} == {TrackState.INITIALISING}


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_fix_is_found_and_repaired(seed: int) -> None:
    """A pose from outside in the neighbouring sector, sure of itself."""
    walk = Walk(np.array([0.5, 4.0]), 0.2 + seed, 5.0, seed)
    sine = math.sin(math.atan2(*walk.start)) + 1 / TURNS
    wrong = np.hypot(*walk.start) * np.array([sine, math.sqrt(1 - sine**2)])
    pose = InitialPose(
        stamp_ns=T0, vue_id="v", position=np.array([*wrong, 0.0]), cov=np.eye(3) * 0.1**2
    )
    outputs = tracked(walk, [pose])
    error = errors(walk, outputs)
    assert error[2] > 0.5
    assert outputs[-1].status.rejected["sector_corrected"] == 1
    assert outputs[-1].status.state == TrackState.TRACKING
    assert error[-10:].max() < 0.15


def test_a_right_fix_is_never_corrected() -> None:
    for seed in range(5):
        outputs = tracked(Walk(np.array([-2.0, 3.0]), 0.3, 4.0, seed))
        assert "sector_corrected" not in outputs[-1].status.rejected


def test_a_rough_pose_from_outside_chooses_the_sector_at_once() -> None:
    """Within half a metre: the posterior of the pose, not the nearest number of turns to it."""
    walk = Walk(np.array([0.5, 4.0]), 0.2, 2.0, 3)
    pose = InitialPose(
        stamp_ns=T0, vue_id="v", position=np.array([0.4, 4.2, 0.0]), cov=np.eye(3) * 0.2**2
    )
    outputs = tracked(walk, [pose])
    assert outputs[1].status.state == TrackState.TRACKING
    assert errors(walk, outputs).max() < 0.15


@pytest.mark.parametrize("seed", range(4))
def test_a_slip_while_hidden_is_survived(seed: int) -> None:
    """Hidden for 5 s with a velocity off by 0.15 m/s: the prediction ends 0.75 m aside, in the
    neighbouring sector; what is then nearest to it is the wrong place."""
    walk = Walk(np.array([-3.0, 3.0]), 0.15, 9.0, seed, hidden=(2.0, 6.0))
    gone = slice(20, 60)
    walk.velocities[gone] += 0.15 * np.array([1.0, 0.0])
    outputs = tracked(walk, accel_density_mps2_sqrthz=0.5)
    error = errors(walk, outputs)
    assert error[59] > 0.4
    assert error[-10:].max() < 0.15
    assert outputs[-1].status.state == TrackState.TRACKING


@pytest.mark.parametrize("seed", range(3))
def test_a_burst_of_wrong_phases_is_survived(seed: int) -> None:
    walk = Walk(np.array([-2.0, 3.0]), 0.3, 6.0, seed, spoilt=(2.5, 3.3))
    error = errors(walk, tracked(walk))
    assert error[20:25].max() < 0.15
    assert error[-10:].max() < 0.15


def test_half_a_wavelength_needs_no_decision() -> None:
    """K = 1: one sector, decided by the first measurement."""
    config = TrackerConfig(**CONFIG)
    info = RsuInfo(
        rsu_id="anchor",
        position=np.zeros(3),
        quaternion=NORTH,
        baseline_m=WAVELENGTH / 2,
        wavelength_m=WAVELENGTH,
    )
    xy = np.array([[1.0, 4.0]])
    sine = math.sin(math.atan2(1.0, 4.0))
    walk = Walk(xy[0], 0.0, 0.1)
    measured = walk.measured(0)
    measured.phase_difference_rad = math.pi * sine
    rows = rsu_rows(measured, info, rsu_axes(info), 0)
    bank = Sectors.begin(config, T0, rows, 1, pose_state(config, np.zeros(2), np.eye(2)))
    assert bank is not None
    assert bank.decided
    assert np.hypot(*(bank.mean[:2] - xy[0])) < 0.1


def test_late_measurements_give_the_estimates_of_arrival_in_order() -> None:
    walk = Walk(np.array([-1.0, 4.0]), 0.4, 2.0, seed=5)
    in_order = tracked(walk)
    tracker = Tracker(TrackerConfig(**CONFIG))
    tracker.add_rsu(INFO)
    held: list[Any] = []
    last: TrackOutput | None = None
    for k in range(20):
        items = walk.items(k)
        if k in (6, 11):
            held.append(items.pop())
        for item in items:
            assert tracker.add(item) is None
        if k in (9, 15):
            assert tracker.add(held.pop(0)) is None
        for output in tracker.process():
            last = output
    for output in tracker.flush():
        last = output
    assert last is not None
    assert last.odometry is not None
    assert in_order[-1].odometry is not None
    np.testing.assert_array_equal(last.odometry.position, in_order[-1].odometry.position)
    np.testing.assert_array_equal(last.odometry.pose_cov, in_order[-1].odometry.pose_cov)


def test_a_copy_goes_its_own_way() -> None:
    walk = Walk(np.array([0.8, 4.5]), 0.3, 0.6, 1)
    config = TrackerConfig(**CONFIG)
    start = pose_state(config, np.zeros(2), np.eye(2))
    bank = Sectors.begin(config, T0, rows_at(walk, 0, 0.05), 1, start)
    assert bank is not None
    twin = bank.copy()
    mean, weights = bank.mean.copy(), bank.probabilities.copy()
    twin.step(T0 + DT_NS, 0.1, 0, rows_at(walk, 1, 0.05), NO_BIAS)
    np.testing.assert_array_equal(bank.mean, mean)
    np.testing.assert_array_equal(bank.probabilities, weights)
    assert not np.array_equal(twin.probabilities, weights)


def test_a_second_rsu_with_biases_settles_the_first_epoch() -> None:
    """Its range tells the sectors apart in two epochs; its bias becomes a state later."""
    tracker = Tracker(TrackerConfig(**CONFIG))
    tracker.add_rsu(INFO)
    biased = {"range_bias_sd_m": 0.05, "bias_correlation_time_s": 60.0}
    tracker.add_rsu(RsuInfo(rsu_id="side", position=np.array([9.0, 4.0, 0.0]), **biased))  # type: ignore[arg-type]
    walk = Walk(np.array([0.5, 4.0]), 0.2, 2.0, 3)
    outputs: list[TrackOutput] = []
    for k in range(20):
        stamp = T0 + k * DT_NS
        measured = walk.measured(k)
        measured.expected = 2
        side = RsuMeasurement(
            stamp_ns=stamp,
            rsu_id="side",
            vue_id="v",
            expected=2,
            fields=Field.RANGE,
            range_m=float(np.hypot(*(walk.position[k] - [9.0, 4.0]))),
            range_var=0.05**2,
        )
        for item in (side, measured):
            assert tracker.add(item) is None
        outputs += tracker.process()
    assert outputs[1].status.state == TrackState.TRACKING
    error = errors(walk, [*outputs, *tracker.flush()])
    assert error.max() < 0.25
    assert error[-5:].max() < 0.1


def test_where_a_phase_with_its_range_is_found() -> None:
    walk = Walk(np.array([0.8, 4.5]), 0.3, 0.2, 1)
    rows = rows_at(walk, 0, 0.1)
    assert phase_place(rows) == 1
    assert phase_place(rows[[2, 3, 0, 1]]) == 3
    assert phase_place(rows[1:]) == -1
    assert phase_place(rows[:1]) == -1
    assert sectors_of(rows[1]) == 11


def test_the_weights_that_meet_in_a_sector_add_up() -> None:
    """Heir is the filter that gives a sector most; a sector nobody explains gets the floor."""
    phase = rows_at(Walk(np.array([0.8, 4.5]), 0.3, 0.2, 1), 0, 0.1)[1]
    phase[VALUE] = 0.0
    with np.errstate(divide="ignore"):
        gains = np.log(np.zeros((11, 11)))
        gains[4, 5], gains[5, 5], gains[6, 7] = np.log([0.2, 0.3, 0.5])
    weights, heirs = np.zeros(11), np.zeros(11, dtype=np.int64)
    sector_bank._inherit(gains, weights, phase, 1e-4, heirs)
    expected = np.full(11, 0.5 * 1e-4)
    expected[5], expected[7] = 0.5, 0.5
    expected[[0, 10]] = 0.0  # five turns are none of the array's
    np.testing.assert_allclose(np.exp(weights), expected, rtol=1e-12)
    assert (heirs[5], heirs[7]) == (5, 6)
    assert set(np.delete(heirs, [5, 7]).tolist()) == {-1}


def test_a_fix_says_as_much_as_range_and_phase_do() -> None:
    """Where a tangent reaches, both ways to weigh a number of turns agree."""
    walk = Walk(np.array([0.8, 4.5]), 0.3, 0.2, 1)
    options = options_of(TrackerConfig(**CONFIG))
    rows = rows_at(walk, 0, 0.05)
    turns = round(float(true_values(walk.position)[1][0] - walk.phases[0]) / (2 * math.pi))
    for off in (0.0, 0.03, -0.05):
        mean = np.array([0.8 + off, 4.5 - off, *walk.velocity, 0.0, 0.0])
        L = np.diag([0.03, 0.04, 0.1, 0.1, 1.0, 1.0])
        own = rows.copy()
        own[1, KIND], own[1, VALUE] = Kind.UNWRAPPED_PHASE, rows[1, VALUE] + 2 * math.pi * turns
        innovation, G, E = regress(mean, L, own, 0.0)
        S = innovation_cov(G, E, own[:, VARIANCE].copy())
        gate = options[GATE:]
        expected = sector_bank._evidence(own, innovation, S, gate, np.zeros(2))
        ours = sector_bank._fix_evidence(mean, L, rows, 1, turns, options)
        assert ours == pytest.approx(expected, abs=0.1)
