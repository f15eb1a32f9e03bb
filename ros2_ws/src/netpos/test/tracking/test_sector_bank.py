"""A bank of filters over the sectors of a phase difference, against the posterior on a grid."""

from __future__ import annotations

import math

import numpy as np
import pytest
from anchor_walk import (
    CONFIG,
    DT_NS,
    PHASE_SD,
    RANGE_SD,
    SCALE,
    T0,
    Walk,
    rows_at,
    true_values,
    wrap,
)
from netpos.estimation.measurement import KIND, VALUE, VARIANCE, Kind
from netpos.estimation.motion import NO_BIAS
from netpos.estimation.sigma import innovation_cov, regress
from netpos.messages.values import Array
from netpos.tracking import TrackerConfig, sector_bank
from netpos.tracking.models import options_of, pose_state
from netpos.tracking.sectors import PhaseAmbiguityBank, phase_place, sectors_of
from scipy.special import logsumexp


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


@pytest.mark.parametrize(("seed", "heading"), [(1, 0.3), (2, 2.0), (3, 1.5), (4, -1.0)])
def test_probabilities_are_those_of_the_posterior(seed: int, heading: float) -> None:
    walk = Walk(np.array([0.8, 4.5]), heading, 0.6, seed)
    expected = {k: grid_posterior(walk, k, walk.velocity) for k in (2, 5)}
    for name in ("srukf", "ukf", "iekf"):
        config = TrackerConfig(filter=name, accel_density_mps2_sqrthz=1e-4)
        start = pose_state(config, np.zeros(2), np.eye(2))
        bank = PhaseAmbiguityBank.begin(config, T0, rows_at(walk, 0, 1e-3), 1, start)
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


def test_a_copy_goes_its_own_way() -> None:
    walk = Walk(np.array([0.8, 4.5]), 0.3, 0.6, 1)
    config = TrackerConfig(**CONFIG)
    start = pose_state(config, np.zeros(2), np.eye(2))
    bank = PhaseAmbiguityBank.begin(config, T0, rows_at(walk, 0, 0.05), 1, start)
    assert bank is not None
    twin = bank.copy()
    mean, weights = bank.mean.copy(), bank.probabilities.copy()
    twin.step(T0 + DT_NS, 0.1, 0, rows_at(walk, 1, 0.05), NO_BIAS)
    np.testing.assert_array_equal(bank.mean, mean)
    np.testing.assert_array_equal(bank.probabilities, weights)
    assert not np.array_equal(twin.probabilities, weights)


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
        gate = options.gate_nis
        expected = sector_bank._evidence(own, innovation, S, gate, np.zeros(2))
        ours = sector_bank._fix_evidence(mean, L, rows, 1, turns, options)
        assert ours == pytest.approx(expected, abs=0.1)
