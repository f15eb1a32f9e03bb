"""The particle filter of short Gaussians against sums on a grid, closed forms and the bootstrap
filter; the comparison with the tracker at tiny settings."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from netpos.estimation.measurement import VALUE, predict_row
from netpos.estimation.rows import rsu_axes, rsu_rows
from netpos.messages.values import Array, Field, RsuInfo, RsuMeasurement
from oracle_problems import Case, draw
from oracle_scores import apart, posteriors
from particle_filter import Start
from particle_gaussian_kernels import chosen, shortened
from particle_gaussians import GaussianParticles, StepMotion
from particle_kernels import Kind
from scipy.stats import norm
from script_parts import loaded

KNOWN_CLOCK = {"clock_mean": (0.0, 0.0), "clock_sd": (1e-3, 1e-3)}


def bearing(angle: float, sd: float, x: float = 0.0, y: float = 0.0) -> Array:
    return np.array([Kind.BEARING, angle, sd, x, y, 0.0, 0.0])


def follow(case: Case, particles: int, seed: int) -> list[tuple[Array, Array]]:
    """Mean and covariance of the position at the scored steps."""
    motion = StepMotion(accel=case.motion.accel, clock=case.motion.clock)
    oracle = GaussianParticles(case.start, motion, particles, seed)
    found, now = [], 0.0
    oracle.begin(case.steps[0].rows[0])
    for k, step in enumerate(case.steps):
        rows = step.rows[1:] if k == 0 else step.rows
        oracle.advance(np.full(len(rows), step.time_s - now), rows)
        now = step.time_s
        if step.scored:
            found.append(oracle.moments())
    return found


@pytest.mark.parametrize("seed", [1, 2])
def test_agrees_with_the_bootstrap_filter(seed: int) -> None:
    """A third of problem 3: one RSU, unknown clock."""
    case = draw(3, seed, 0.34)
    moments = follow(case, 500, seed)
    assert len(moments) == 2
    for (_, cloud, _), (mean, cov) in zip(posteriors(case, 6000, seed), moments, strict=True):
        assert apart(mean, cloud) < 0.25
        assert np.trace(cov) == pytest.approx(np.trace(cloud.cov), rel=0.3)


def test_the_first_bearing_agrees_with_a_sum_on_a_grid() -> None:
    """A prior as wide as the RSU is far, and far off the ray."""
    start = Start(mean=np.array([6.0, 4.0, 0, 0]), position_sd=5.0, velocity_sd=1.0, **KNOWN_CLOCK)
    oracle = GaussianParticles(start, StepMotion(accel=0.1), 1, seed=1)
    oracle.begin(bearing(-0.4, 0.03))
    r, angle = np.meshgrid(np.linspace(0.005, 40.0, 8000), np.linspace(-0.6, -0.2, 401))
    x, y = r * np.cos(angle), r * np.sin(angle)
    log = -((x - 6.0) ** 2 + (y - 4.0) ** 2) / 50.0 - (angle + 0.4) ** 2 / (2 * 0.03**2)
    weight = r * np.exp(log)
    weight /= weight.sum()
    exact = np.array([(weight * x).sum(), (weight * y).sum()])
    d = x - exact[0], y - exact[1]
    cov = np.array([[(weight * a * b).sum() for a in d] for b in d])
    mean, found = oracle.moments()
    assert math.sqrt((mean - exact) @ np.linalg.solve(cov, mean - exact)) < 0.02
    np.testing.assert_allclose(found, cov, atol=0.02 * np.trace(cov))


def test_a_velocity_step_agrees_with_a_sum_over_its_time() -> None:
    """Far from the RSU a bearing is linear in the position across: the posterior is a Gaussian
    without a step, and one for each time of a step."""
    sd, far, dt, rate, step_sd, noise, value = 0.3, 1e4, 2.0, 0.1, 4.0, 0.5, 3.0
    start = Start(mean=np.zeros(4), position_sd=sd, velocity_sd=sd, **KNOWN_CLOCK)
    motion = StepMotion(accel=1e-6, steps_hz=rate, step_sd=step_sd)
    oracle = GaussianParticles(start, motion, 20_000, seed=2)
    oracle.advance(np.array([dt]), bearing(value / far, noise / far, -far)[None])
    after = (np.arange(2000) + 0.5) / 2000 * dt
    prior = np.append(0.0, (step_sd * after) ** 2) + sd**2 * (1.0 + dt**2)
    stepped = -math.expm1(-rate * dt)
    weight = np.append(1.0 - stepped, np.full(2000, stepped / 2000))
    weight *= norm.pdf(value, 0.0, np.sqrt(prior + noise**2))
    weight /= weight.sum()
    each = prior / (prior + noise**2) * value
    y = weight @ each
    variance = weight @ (prior * noise**2 / (prior + noise**2) + (each - y) ** 2)
    mean, cov = oracle.moments()
    np.testing.assert_allclose(mean, [0.0, y], atol=0.01)
    np.testing.assert_allclose(np.diag(cov), [weight @ prior, variance], rtol=0.02)


def test_a_turn_to_a_side_agrees_with_a_sum_over_its_time() -> None:
    """As above; all devices that turn do so to a side, with 10 degrees and a twentieth of the
    speed more or less."""
    sd, far, dt, rate, speed, noise, value = 0.3, 1e4, 2.0, 0.1, 5.0, 0.5, 3.0
    start = Start(mean=np.array([0, 0, speed, 0]), position_sd=sd, velocity_sd=sd, **KNOWN_CLOCK)
    motion = StepMotion(
        accel=1e-6,
        steps_hz=rate,
        step_sd=speed,
        to_sides=0.5 * math.e,  # all
        turn_speed_sd=0.05,
        turn_angle_sd=math.radians(10.0),
    )
    oracle = GaussianParticles(start, motion, 20_000, seed=2)
    oracle.advance(np.array([dt]), bearing(value / far, noise / far, -far)[None])
    after = (np.arange(2000) + 0.5) / 2000 * dt
    means = np.concatenate([[0.0], speed * after, -speed * after])
    own = sd**2 * (1.0 + (dt - after) ** 2 + after**2) + (0.05 * speed * after) ** 2
    prior = np.concatenate([[sd**2 * (1.0 + dt**2)], own, own])
    stepped = -math.expm1(-rate * dt)
    weight = np.append(1.0 - stepped, np.full(4000, stepped / 4000))
    weight *= norm.pdf(value, means, np.sqrt(prior + noise**2))
    weight /= weight.sum()
    each = means + prior / (prior + noise**2) * (value - means)
    y = weight @ each
    variance = weight @ (prior * noise**2 / (prior + noise**2) + (each - y) ** 2)
    mean, cov = oracle.moments()
    assert mean[1] == pytest.approx(y, abs=0.02)
    assert cov[1, 1] == pytest.approx(variance, rel=0.03)


def test_what_is_drawn_from_weights_keeps_their_mean() -> None:
    rng = np.random.default_rng(1)
    p = rng.dirichlet(np.full(50, 0.3))
    total = np.zeros(50)
    for _ in range(4000):
        index, weight = chosen(rng, p, 12)
        assert 11 <= index.size <= 13
        assert weight.sum() == pytest.approx(1.0, abs=0.1)
        total[index] += weight
    np.testing.assert_allclose(total / 4000, p, atol=0.005)


def test_shorter_particles_have_the_moments_of_the_long_one() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    mean, cov = np.array([[20.0, 5.0, 1.0, 2.0, 3.0, 4.0]]), (A @ A.T + np.eye(6))[None]
    x, P, parent, share, cut = shortened(rng, mean, cov, np.ones(1), 50_000, np.zeros(2), 0.05)
    assert cut
    assert share.sum() == pytest.approx(1.0)
    assert set(parent) == {0}
    assert np.linalg.eigvalsh(P[:, :2, :2]).max() < np.linalg.eigvalsh(cov[0, :2, :2]).max()
    sd = np.sqrt(np.diag(cov[0]))
    np.testing.assert_allclose(x.mean(axis=0) / sd, mean[0] / sd, atol=0.02)
    whole = P.mean(axis=0) + np.cov(x.T)
    np.testing.assert_allclose(whole / np.outer(sd, sd), cov[0] / np.outer(sd, sd), atol=0.02)


def test_rows_mean_the_same_to_both_filters() -> None:
    """A turned RSU above the device: at the state that the tracker predicts a row from, the
    particle filter finds the same bearing and time."""
    turned = np.array([0.0, 0.0, math.sin(0.35), math.cos(0.35)])
    info = RsuInfo(rsu_id="a", position=np.array([3.0, 4.0, 9.0]), quaternion=turned)
    empty = RsuMeasurement(
        stamp_ns=1, rsu_id="a", vue_id="", fields=Field.AZIMUTH | Field.TOA, azimuth_var=1.0
    )
    rows = rsu_rows(empty, info, rsu_axes(info), 0)
    state = np.array([10.0, -2.0, 1.0, 0.0, 7.0, 0.0])
    for row in rows:
        row[VALUE] = predict_row(row, state, 1.5, np.empty(6))
    azimuth, toa = loaded("oracle_metis").rows_of(rows, 1.5)
    assert azimuth[1] == pytest.approx(math.atan2(-6.0, 7.0))
    slant = math.sqrt((10.0 - toa[3]) ** 2 + (-2.0 - toa[4]) ** 2 + toa[5] ** 2)
    assert slant + 7.0 == pytest.approx(toa[1])


def test_the_script_compares_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = tmp_path / "figures.json"
    tiny = ["--runs", "2", "--particles", "50", "--experiment", "turn", "--json", str(figures)]
    assert loaded("oracle_metis").main(tiny) == 0
    told = json.loads(figures.read_text(encoding="utf-8"))
    first, second = told["routes"]
    both = [[r[name]["rmse_m"] for name in ("oracle", "tracker")] for r in (first, second)]
    count = np.array([first["epochs"], second["epochs"]])
    expected = np.sqrt(count @ np.square(both) / count.sum())
    np.testing.assert_allclose(told["summary"]["rmse_m"], expected)
    assert len(capsys.readouterr().out.splitlines()) == 4 + len(told["summary"])
