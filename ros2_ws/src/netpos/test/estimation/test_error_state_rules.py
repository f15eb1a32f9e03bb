"""What the error-state filter iterates, when it takes a vehicle to stand, and what it holds."""

from __future__ import annotations

import numpy as np
import pytest
from error_states import LEVER_ARM, NOISE, OPEN, linearised, vehicle
from filter_rows import row
from netpos.estimation.measurement import GATE_VARIANCE, GROUP, VALUE, VARIANCE, Kind
from netpos.estimation.spatial.error_state import (
    MEMORY,
    QUIET,
    REST_FORCE,
    Constraints,
    Sensors,
    apply_constraints,
    correct,
    doubt_standstill,
)
from netpos.estimation.spatial.space import bend_mean, bend_variance, direction_rows, place_rows
from netpos.estimation.state import NAV_POSITION, NAV_VELOCITY
from netpos.inertial.strapdown import ERR, GYRO_BIAS, NAV, inject, still_earth
from netpos.messages.values import Array


def rsu_row(kind: Kind, origin: Array, group: int) -> Array:
    variance, gate_variance = (1e-3, 4e-4) if kind is Kind.AZIMUTH else (0.09, 0.05)
    return row(
        kind, 0.0, variance, group, origin, gate_variance=gate_variance, lever_arm=LEVER_ARM
    )


def correct_by_the_rule(nav: Array, cov: Array, rows: Array) -> tuple[Array, Array, float, int]:
    """All rows at once by NumPy, linearised again at the result until the place has settled: six
    times at most; nav, cov, NIS and how many."""

    def from_mean(x: Array, P: Array) -> tuple[Array, Array]:
        z, H = linearised(rows, x)
        return z - [bend_mean(r, x, P) for r in rows], H

    bend = np.array([bend_variance(r, nav, cov) for r in rows])
    z, H = from_mean(nav, cov)
    S = H @ cov @ H.T + np.diag(rows[:, GATE_VARIANCE] + bend)
    nis, error, x, P, count = float(z @ np.linalg.solve(S, z)), np.zeros(ERR), nav, cov, 0
    moved = np.inf
    while moved >= 1e-4 and count < 6:
        z, H = from_mean(x, P)
        gain = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + np.diag(rows[:, VARIANCE] + bend))
        last, error = error, gain @ (z + H @ error)
        x = nav.copy()
        inject(x, error)
        moved, count = np.abs(error - last)[:3].max(), count + 1
        P = cov - gain @ H @ cov
    return x, P, nis, count


def problem(seed: int) -> tuple[Array, Array, Array]:
    """Ranges and bearings of near RSUs, a place fix or a velocity of the body, a group each."""
    rng = np.random.default_rng(seed)
    nav, cov = vehicle(rng)
    cov *= 0.1 ** (seed % 5)
    truth = nav.copy()
    inject(truth, np.linalg.cholesky(cov) @ rng.normal(size=ERR))
    kinds = rng.choice([Kind.RANGE, Kind.AZIMUTH, Kind.ELEVATION], 3)
    rows = [rsu_row(Kind(int(k)), rng.normal(0, [15, 15, 4]), g) for g, k in enumerate(kinds)]
    if seed % 2:
        rows += list(place_rows(np.zeros(3), np.eye(3), LEVER_ARM, 3))
    velocity = direction_rows(
        Kind.BODY_VELOCITY, np.eye(3)[1:], np.zeros(2), np.full(2, 0.01), 4 if seed % 2 else 3
    )
    both = np.vstack([*rows, velocity])
    both[:, VALUE] += linearised(both, truth)[0]
    return nav, cov, both


def test_iterations_follow_the_rule() -> None:
    counts = set()
    for seed in range(40):
        nav, cov, rows = problem(seed)
        expected, P_expected, nis_expected, count = correct_by_the_rule(nav, cov, rows)
        before = rows.copy()
        nis, used = correct(nav, cov, rows, OPEN, np.zeros(5))
        counts.add(count)
        sd = np.sqrt(np.diag(P_expected))
        np.testing.assert_allclose(
            (nav - expected)[:6] / sd[:6], 0.0, atol=1e-6, err_msg=str(seed)
        )
        np.testing.assert_allclose(nav[6:], expected[6:], atol=1e-9)
        np.testing.assert_allclose(
            cov / np.outer(sd, sd), P_expected / np.outer(sd, sd), atol=1e-6
        )
        assert (nis, used) == (pytest.approx(nis_expected, rel=1e-8), len(rows))
        np.testing.assert_array_equal(rows, before)
    assert {3, 4, 6} <= counts


def test_iterating_ends_with_the_place() -> None:
    """A fix of the place is linear: the second step does not move it, and the attitude that the
    velocity of the body would still change is left as two steps have it."""
    nav, cov = vehicle(np.random.default_rng(3))
    velocity = direction_rows(
        Kind.BODY_VELOCITY, np.eye(3)[1:], np.array([2.0, 0.5]), np.full(2, 1e-4), 1
    )
    rows = np.vstack(
        [place_rows(nav[NAV_POSITION] + 1.0, 0.01 * np.eye(3), (0.0, 0.0, 0.0)), velocity]
    )
    cov[:3, 3:] = cov[3:, :3] = 0.0
    expected, _, _, count = correct_by_the_rule(nav, cov, rows)
    assert count == 2
    correct(nav, cov, rows, OPEN, np.zeros(2))
    np.testing.assert_allclose(nav, expected, atol=1e-10)


def still(**change: float) -> Sensors:
    limits = {"still_force_mps2": 0.2, "still_rate_radps": 0.05, "standstill_sd_mps": 0.02}
    values = dict.fromkeys(Constraints._fields, 0.0) | limits | change
    return Sensors(NOISE, still_earth(), Constraints(**values))


def chunk_of(rate: Array, force: Array, span_s: float = 0.1) -> Array:
    return np.concatenate([rate, force, [span_s]])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("share", "quiet"), [(1 - 1e-6, 8.0), (1 + 1e-6, 0.0)])
@pytest.mark.parametrize("what", ["turned", "pushed"])
def test_how_long_it_has_been_quiet(what: str, share: float, quiet: float, seed: int) -> None:
    """The length of the rate beside the gyro's bias, and of the force beside its mean."""
    rng = np.random.default_rng(seed)
    nav, cov = vehicle(rng)
    nav[GYRO_BIAS:NAV] = rng.normal(0, 0.01, 3)
    memory = np.zeros(MEMORY)
    memory[QUIET], memory[REST_FORCE:] = 7.0, rng.normal(0, 5, 3)
    rate, force = nav[GYRO_BIAS:NAV].copy(), memory[REST_FORCE:].copy()
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    if what == "turned":
        rate += 0.05 * share * way
    else:
        force += 0.2 * share * way
    apply_constraints(nav, cov, memory, still(), chunk_of(rate, force))
    assert memory[QUIET] == quiet


def test_the_first_force_is_compared_with_none() -> None:
    """Nothing is known of the force before; after that the memory is the mean since."""
    rng = np.random.default_rng(1)
    nav, cov = vehicle(rng)
    memory, forces = np.zeros(MEMORY), [0.0, 0.0, 9.8] + 0.05 * rng.normal(size=(6, 3))
    for k, force in enumerate(forces):
        apply_constraints(nav, cov, memory, still(), chunk_of(np.zeros(3), force))
        assert memory[QUIET] == k + 1
        np.testing.assert_allclose(memory[REST_FORCE:], forces[: k + 1].mean(axis=0), rtol=1e-12)
    apply_constraints(nav, cov, memory, still(), chunk_of(np.ones(3), np.full(3, 9.0)))
    assert memory[QUIET] == 0.0
    np.testing.assert_array_equal(memory[REST_FORCE:], 9.0)  # where the next rest begins


def test_after_a_doubt_nothing_stands_for_a_hundred_chunks() -> None:
    nav, cov = vehicle(np.random.default_rng(1))
    memory, rest = np.zeros(MEMORY), chunk_of(np.zeros(3), np.array([0.0, 0.0, 9.8]))
    doubt_standstill(memory)
    for k in range(100):
        apply_constraints(nav, cov, memory, still(), rest if k % 7 else rest + 5.0)
        assert memory[QUIET] == k - 99
    apply_constraints(nav, cov, memory, still(), rest)
    assert memory[QUIET] == 1.0
    apply_constraints(nav, cov, memory, still(), rest + 5.0)
    assert memory[QUIET] == 0.0


def held(quiet: float, speed: float, sensors: Sensors) -> tuple[Array, Array, Array, Array]:
    """State and covariance before and after a quiet chunk of 0.08 s."""
    rng = np.random.default_rng(2)
    nav, cov = vehicle(rng)
    nav[NAV_VELOCITY] = speed * np.array([0.6, 0.64, 0.48])
    nav[GYRO_BIAS:NAV] = 0.002, -0.003, 0.001
    before = nav.copy(), cov.copy()
    memory = np.zeros(MEMORY)
    memory[QUIET], memory[REST_FORCE:] = quiet, 1.0
    apply_constraints(
        nav, cov, memory, sensors, chunk_of(np.array([0.01, 0.02, -0.015]), np.ones(3), 0.08)
    )
    return (*before, nav, cov)


@pytest.mark.parametrize(
    ("quiet", "speed", "sd", "stands"),
    [
        (19.0, 0.99, 0.02, True),
        (18.0, 0.99, 0.02, False),
        (19.0, 1.01, 0.02, False),
        (19.0, 0.99, 0.0, False),
    ],
)
def test_standing_is_twenty_quiet_chunks_at_less_than_walking_speed(
    quiet: float, speed: float, sd: float, stands: bool
) -> None:
    """Velocity and gyro are then held: three rows of velocity, three of the rate as measured, of
    the variance of white noise over the chunk; else nothing is known and nothing changes."""
    x, P, nav, cov = held(quiet, speed, still(standstill_sd_mps=sd))
    if stands:
        rate_var = NOISE.gyro_density_radps_sqrthz**2 / 0.08
        values, rates = np.zeros(3), np.array([0.01, 0.02, -0.015])
        rows = np.vstack(
            [
                direction_rows(Kind.BODY_VELOCITY, np.eye(3), values, np.full(3, sd**2), 0),
                direction_rows(Kind.BODY_RATE, np.eye(3), rates, np.full(3, rate_var), 0),
            ]
        )
        rows[:, GROUP] = range(6)
        correct(x, P, rows, np.array([0.0, 15.14]), np.zeros(6))
    np.testing.assert_array_equal(nav, x)
    np.testing.assert_array_equal(cov, P)


@pytest.mark.parametrize(("sideways", "upwards"), [(0.1, 0.0), (0.0, 0.2), (0.1, 0.2)])
def test_a_vehicle_under_way_is_held_across_it(sideways: float, upwards: float) -> None:
    x, P, nav, cov = held(
        0.0, 0.9, still(sideways_sd_mps=sideways, upwards_sd_mps=upwards, standstill_sd_mps=0.0)
    )
    sds = {1: sideways, 2: upwards}
    axes = [axis for axis, sd in sds.items() if sd > 0.0]
    variances = np.array([sds[axis] ** 2 for axis in axes])
    rows = direction_rows(Kind.BODY_VELOCITY, np.eye(3)[axes], np.zeros(len(axes)), variances, 0)
    rows[:, GROUP] = range(len(axes))
    correct(x, P, rows, np.array([0.0, 15.14]), np.zeros(2))
    np.testing.assert_allclose(nav, x, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(cov, P, rtol=1e-12, atol=1e-15)
    assert not np.array_equal(cov, held(0.0, 0.9, still(standstill_sd_mps=0.0))[1])
