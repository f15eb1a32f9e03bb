"""The compiled epoch and the compiled run against a restatement of their rules in plain Python."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from engine_cases import opened, start
from netpos.estimation import engine
from netpos.estimation.engine import EpochInput, Epochs, FilterOptions, Run, empty_run
from netpos.estimation.forms import ekf
from netpos.estimation.measurement import (
    GROUP,
    ROW_WIDTH,
    Kind,
)
from netpos.estimation.mixture.epoch import run_epochs
from netpos.estimation.motion import NO_BIAS, SPEED_OF_LIGHT_MPS, Parameter, noise
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.estimation.state import POSITION, X
from netpos.estimation.update import conditioning
from netpos.estimation.update.predicted import predicted_rows
from netpos.messages.values import Array, Field, InitialPose, RsuInfo, RsuMeasurement
from netpos.scenario import Simulation, load_scenario
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.estimators.models import dynamics_of, motions_of, options_of, pose_state

STATIONS = [
    RsuInfo(rsu_id=f"{i}", position=np.array([*xy, 4.0]))
    for i, xy in enumerate([(0.0, 10.0), (60.0, -10.0), (120.0, 10.0)])
]
CLOCK = {"clock_offset_sd_s": 1e-7, "clock_drift_mean": 0.0, "clock_drift_sd": 1e-8}


def rows_of(state: Array, rng: np.random.Generator, wrong: tuple[int, ...] = ()) -> Array:
    """Azimuth and TOA of three RSUs; those in ``wrong`` are 1 rad off."""
    blocks = []
    for group, info in enumerate(STATIONS):
        d = state[POSITION] - info.position[:2]
        m = RsuMeasurement(
            stamp_ns=1,
            rsu_id=info.rsu_id,
            vue_id="v",
            fields=Field.AZIMUTH | Field.TOA,
            azimuth_rad=math.atan2(d[1], d[0]) + 0.01 * rng.normal() + (group in wrong),
            azimuth_var=1e-4,
            toa_s=(math.hypot(*d, 4.0) + state[X.CLOCK] + 0.3 * rng.normal()) / SPEED_OF_LIGHT_MPS,
            toa_var=(0.3 / SPEED_OF_LIGHT_MPS) ** 2,
        )
        blocks.append(rsu_rows(m, info, rsu_axes(info), group))
    return np.vstack(blocks)


def gated(
    mean: Array, cov: Array, rows: Array, options: FilterOptions
) -> tuple[Array, Array, float, int, Array]:
    x, P, accepted = mean.copy(), cov.copy(), np.zeros(int(rows[-1, GROUP]) + 1)
    work = ekf.workspace(len(x), len(rows))
    height, gate = options.height_m, options.gate_nis
    nis, used = ekf.update(x, P, rows, height, gate, options.iterations, accepted, work)
    return x, P, nis, used, accepted


def plain_step(
    mean: Array,
    cov: Array,
    dt: float,
    unheard_s: float,
    rejected: int,
    rows: Array,
    motion: Array,
    options: FilterOptions,
    allowed: Array | None = None,
) -> tuple[Array, Array, float, int, Array]:
    """The rules: predict; open after too many rejected epochs; re-weight what is to be; nothing
    accepted leaves the prediction. What was added to the prediction, if anything was accepted, is
    added to ``allowed``."""
    prior, prior_cov = mean.copy(), cov.copy()
    ekf.predict(prior, prior_cov, dt, motion, NO_BIAS)
    P = prior_cov
    if rejected >= options.inflate_after:
        P = opened(P, options.initial_speed_sd, unheard_s)
    rows = rows.copy()
    conditioning.reweight(P, rows, predicted_rows(prior, P, rows, 0.0), options.robust)
    best = gated(prior, P, rows, options)
    if not best[4].any():
        return prior, prior_cov, best[2], best[3], best[4]
    if allowed is not None:
        allowed += P - prior_cov
    return best


def compiled_step(
    mean: Array,
    cov: Array,
    dt: float,
    unheard_s: float,
    rejected: int,
    rows: Array,
    motion: Array,
    options: FilterOptions,
) -> tuple[Array, Array, float, int, Array]:
    x, S = mean.copy(), engine.to_cov_or_sqrt(cov, options)
    scratch, epoch = engine.scratch(6, len(rows)), EpochInput(dt, unheard_s, dt, rejected, rows)
    engine.predict_epoch(x, S, epoch, motion, NO_BIAS, options, scratch)
    result = engine.update_epoch(x, S, epoch, motion, options, scratch)
    accepted = scratch.accepted[:3]
    assert result.groups == accepted.sum()
    return x, engine.to_cov(S, options), result.nis, result.used, accepted


CASES = {
    "all fits": ({}, 0, (), 0.0, 3),
    "one is off": ({}, 0, (1,), 0.0, 2),
    "nothing fits": ({}, 0, (0, 1, 2), 90.0, 0),
    "nothing fits even opened": ({}, 2, (0, 1, 2), 900.0, 0),
    "moved, not yet opened": ({}, 1, (), 6.0, 0),
    "moved, opened": ({}, 2, (), 6.0, 3),
    "weighed": ({"robust": "huber", "robust_parameter": 1.3}, 0, (), 1.5, 2),
    "late": ({"nlos_probability": 0.3}, 0, (), 2.0, 2),
    "no gate": ({"gate_probability": 1.0}, 0, (0, 1), 6.0, 3),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("filter_name", ["ekf", "iekf"])
def test_step_follows_the_rules(filter_name: str, name: str) -> None:
    change, rejected, wrong, moved, taken = CASES[name]
    config = TrackerConfig(filter=filter_name, initial_speed_sd_mps=5.0, **change)
    options, motion = options_of(config), motions_of(config)[0]
    mean, cov = start()
    cov *= 0.01
    truth = mean.copy()
    truth[POSITION] += [0.8, moved]
    rows = rows_of(truth, np.random.default_rng(3), wrong)
    kept = rows.copy()
    own = motion.copy()  # the step notes there which velocity step it allowed for
    own[Parameter.VELOCITY_STEP_SD] = 7.0  # in the epoch before
    got = compiled_step(mean, cov, 0.1, 1.3, rejected, rows, own, options)
    allowed, noted, without = np.zeros((3, 6, 6))
    want = plain_step(mean, cov, 0.1, 1.3, rejected, kept, motion, options, allowed)
    assert got[4].sum() == taken
    np.testing.assert_array_equal(got[4], want[4])
    assert (got[2], got[3]) == (pytest.approx(want[2], rel=1e-12), want[3])
    np.testing.assert_allclose(got[0], want[0], rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(got[1], want[1], rtol=1e-11, atol=1e-13)
    noise(mean, 0.1, own, NO_BIAS, noted)
    noise(mean, 0.1, motion, NO_BIAS, without)
    np.testing.assert_allclose(noted - without, allowed, rtol=1e-9, atol=1e-11)
    assert np.array_equal(rows, kept) is (name not in {"weighed", "late"})
    if taken == 0:  # exactly the prediction
        ekf.predict(mean, cov, 0.1, motion, NO_BIAS)
        np.testing.assert_array_equal(got[0], mean)
        np.testing.assert_array_equal(got[1], cov)


def drive(epochs: int = 60) -> tuple[Array, Array, Array]:
    """Stamps, row starts and rows: a straight run with outliers, empty epochs and a jump that is
    rejected until the velocity opens."""
    rng = np.random.default_rng(11)
    state, _ = start()
    stamps, starts, blocks = [], [0], []
    for k in range(epochs):
        stamps.append(1_000_000_000 + 100_000_000 * k)
        state[X.PX] += 0.8
        if k == 30:
            state[X.PY] += 6.0
        wrong = (1,) if k % 7 == 3 else ()
        rows = rows_of(state, rng, wrong) if k % 11 else np.zeros((0, ROW_WIDTH))
        blocks.append(rows)
        starts.append(starts[-1] + len(rows))
    return np.array(stamps), np.array(starts), np.vstack(blocks)


def run(config: TrackerConfig, mean: Array, cov: Array, inputs: Any) -> tuple[int, Run]:
    stamps, starts, rows = inputs
    N, n = len(stamps), len(mean)
    out = empty_run(N, n)
    before, dynamics = rows.copy(), dynamics_of(config, NO_BIAS)
    epochs = Epochs(stamps, starts, rows)
    done = run_epochs(epochs, mean, cov, dynamics, options_of(config), out)
    np.testing.assert_array_equal(rows, before)
    return done, out


@pytest.mark.parametrize("change", [{}, {"filter": "ekf"}])
def test_a_run_is_its_steps(change: dict[str, Any]) -> None:
    held = {"accel_density_mps2_sqrthz": 0.5, "clock_walk_density": 5e-7}
    held["manoeuvre_speed_sd_mps"] = 0.0
    config = TrackerConfig(**change, **held)
    motion, options = motions_of(config)[0], options_of(config)
    mean, cov = start()
    stamps, starts, rows = drive()
    done, (means, covs, nis, dof, taken, *_) = run(config, mean, cov, (stamps, starts, rows))
    assert done == len(stamps)
    rejected, heard = 0, stamps[0]
    rejected_most = 0
    for k, stamp in enumerate(stamps):
        dt = (stamp - stamps[max(k - 1, 0)]) * 1e-9
        own = rows[starts[k] : starts[k + 1]]
        if len(own):
            unheard_s = (stamp - heard) * 1e-9
            mean, cov, q, used, accepted = plain_step(
                mean, cov, dt, unheard_s, rejected, own, motion, options
            )
            rejected = 0 if 2 * accepted.sum() >= accepted.size else rejected + 1
            heard = stamp if accepted.any() else heard
            assert (dof[k], taken[k]) == (used, accepted.sum())
            assert nis[k] == pytest.approx(q, rel=1e-8)
        else:
            ekf.predict(mean, cov, dt, motion, NO_BIAS)
            assert (nis[k], dof[k], taken[k]) == (0.0, 0, 0)
        rejected_most = max(rejected, rejected_most)
        np.testing.assert_allclose(means[k], mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(covs[k], cov, rtol=1e-8, atol=1e-11)
    assert rejected_most == 3


def test_a_run_ends_where_the_track_is_lost() -> None:
    config = TrackerConfig(
        max_rejected_epochs=3, inflate_after_epochs=100, filter="ekf", manoeuvre_speed_sd_mps=0.0
    )
    mean, cov = start()
    stamps, starts, rows = drive(60)
    done, (means, _, _, _, taken, *_) = run(config, mean, 1e-4 * cov, (stamps, starts, rows))
    lost = 33  # the epochs 30, 31, 32 are rejected; 33 has no rows
    assert done == lost
    assert taken[29] > 0
    assert (taken[30:33] == 0).all()
    assert np.isnan(means[lost:]).all()


# against the tracker

METIS = "metis_madrid"


@pytest.fixture(scope="module")
def metis() -> tuple[Any, list[Any]]:
    """RSUs, parameters and the first minute of the shipped scenario."""
    scenario = load_scenario(METIS)
    simulation = Simulation(scenario)
    items: list[Any] = []
    first_ns = None
    for event in simulation.events():
        first_ns = event.stamp_ns if first_ns is None else first_ns
        if event.stamp_ns > first_ns + 60 * 10**9:
            break
        if isinstance(event, InitialPose):
            items.append(event)
        elif type(event).__name__ == "Beacon":
            items += simulation.measure(event)
    return (simulation.rsus, dict(scenario.tracker)), items


def as_rows(rsus: Any, items: list[Any]) -> tuple[Array, Array, Array]:
    infos = {info.rsu_id: info for info in rsus}
    by_stamp: dict[int, list[RsuMeasurement]] = {}
    for item in items:
        if isinstance(item, RsuMeasurement):
            by_stamp.setdefault(item.stamp_ns, []).append(item)
    starts, blocks = [0], []
    for stamp in sorted(by_stamp):
        found = sorted(by_stamp[stamp], key=lambda m: m.rsu_id)
        for group, m in enumerate(found):
            info = infos[m.rsu_id]
            blocks.append(rsu_rows(m, info, rsu_axes(info), group))
        starts.append(sum(len(b) for b in blocks))
    return np.array(sorted(by_stamp)), np.array(starts), np.vstack(blocks)


@pytest.mark.parametrize(("name", "rtol"), [("iekf", 0.0), ("ekf", 0.0), ("srukf", 1e-9)])
def test_a_run_equals_the_tracker(metis: Any, name: str, rtol: float) -> None:
    """The whole minute, measurement by measurement through the tracker and in one call."""
    (rsus, parameters), items = metis
    config = TrackerConfig.from_mapping(
        parameters | {"filter": name, "isolate_rsus": False, "max_rejected_epochs": 1000}
    )
    (pose,) = [item for item in items if isinstance(item, InitialPose)]
    tracker = Tracker(config)
    for info in rsus:
        tracker.add_rsu(info)
    outputs = []
    for item in items:
        assert tracker.add(item) is None
        outputs += tracker.process()
    outputs += tracker.flush()
    stamps, starts, rows = as_rows(rsus, items)
    assert pose.stamp_ns <= stamps[0]
    mean, cov = pose_state(config, pose.position[:2], pose.cov[:2, :2])
    done, (means, covs, nis, dof, taken, *_) = run(config, mean, cov, (stamps, starts, rows))
    outputs = [o for o in outputs if o.status.stamp_ns >= stamps[0]]
    assert done == len(stamps) == len(outputs) > 600
    assert pose.stamp_ns == stamps[0]
    assert [o.status.stamp_ns for o in outputs] == stamps.tolist()
    assert [o.status.used for o in outputs] == taken.tolist()
    assert [o.status.nis_dof for o in outputs] == dof.tolist()
    c = SPEED_OF_LIGHT_MPS
    compared = [
        ([o.odometry.position[:2] for o in outputs], means[:, POSITION]),
        ([o.odometry.pose_cov[:2, :2] for o in outputs], covs[:, POSITION, POSITION]),
        ([o.status.nis for o in outputs], nis),
        ([o.clock.offset_s for o in outputs], means[:, X.CLOCK] / c),
        ([tracker._tracks[pose.vue_id]._state.estimator.estimate.mean], means[-1:]),
        ([tracker._tracks[pose.vue_id]._state.estimator.estimate.cov], covs[-1:]),
    ]
    for got, want in compared:
        if rtol == 0.0:
            np.testing.assert_array_equal(np.array(got), want)
        else:
            np.testing.assert_allclose(np.array(got), want, rtol=rtol, atol=1e-9)


def test_rows_are_what_the_tests_say() -> None:
    rows = rows_of(start()[0], np.random.default_rng(0))
    assert rows[:, 0].tolist() == [Kind.AZIMUTH, Kind.TOA] * 3
    assert rows[:, GROUP].tolist() == [0, 0, 1, 1, 2, 2]
