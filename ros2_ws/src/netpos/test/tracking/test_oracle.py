"""The particle-filter oracle against closed forms, quadrature and its own truth; the comparison
with the tracker at tiny settings."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from netpos.messages.values import Array
from oracle_problems import PROBLEMS, draw
from oracle_scores import alone, apart, nees_test, rank_p_value
from oracle_table import BEGIN, END, write_between_marks
from particle_filter import Motion, ParticleFilter, Start
from particle_kernels import Kind, weigh
from posterior import Cloud, Modes
from scipy.integrate import quad
from scipy.stats import chi2, norm
from script_parts import loaded

RANGE_SD = 0.2


def row(
    kind: Kind, value: float, sd: float, x: float = 0.0, y: float = 0.0, *more: float
) -> Array:
    return np.array([kind, value, sd, x, y, *(*more, 0.0, 0.0)[:2]])


def cloud_of(oracle: ParticleFilter) -> Cloud:
    return Cloud(oracle.state[:, :2], oracle.probability)


def kalman(start: Start, accel: float, dt: float, epochs: list[Array]) -> tuple[Array, Array]:
    """Mean and covariance of a textbook Kalman filter of STATE rows."""
    x, P = start.mean.astype(float), np.diag([start.position_sd**2, start.velocity_sd**2])
    P = np.kron(P, np.eye(2))
    F = np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(2))
    q = accel**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    for k, rows in enumerate(epochs):
        if k > 0:
            x, P = F @ x, F @ P @ F.T + np.kron(q, np.eye(2))
        for _, value, sd, _, _, index, _ in rows:
            h = np.eye(4)[int(index)]
            S = h @ P @ h + sd**2
            x, P = x + P @ h * (value - h @ x) / S, P - np.outer(P @ h, P @ h) / S
    return x, P


@pytest.mark.parametrize("turns_hz", [0.0, 1e-12], ids=["starts moved", "plain bootstrap"])
def test_agrees_with_a_kalman_filter(turns_hz: float) -> None:
    """A linear Gaussian problem, with and without moves of the starts (a motion that turns has
    none); the rate is that of no turn in any trial."""
    rng, n, dt, accel = np.random.default_rng(3), 20_000, 0.1, 0.7
    start = Start(mean=np.array([1.0, -2.0, 0.5, 0.0]), position_sd=1.0, velocity_sd=0.8)
    epochs = [
        np.array(
            [
                row(Kind.STATE, float(rng.normal(k * 0.05 * (1 - a), 0.3)), 0.3, 0.0, 0.0, a)
                for a in range(2)
            ]
        )
        for k in range(20)
    ]
    oracle = ParticleFilter(start, Motion(accel=accel, turns_hz=turns_hz), n, seed=1)
    for k, rows in enumerate(epochs):
        oracle.predict(dt if k > 0 else 0.0)
        oracle.update(rows)
    mean, cov = kalman(start, accel, dt, epochs)
    p = oracle.probability
    found = p @ oracle.state
    d = oracle.state - found
    # Of independent draws the largest of 4 means would be 2.5 / sqrt(n) sd off; particles have
    # ancestors in common, so that as few as a 50th of them count.
    few = 50.0 / n
    assert np.abs((found - mean) / np.sqrt(np.diag(cov))).max() < 2.5 * math.sqrt(few)
    np.testing.assert_allclose(d.T @ (p[:, None] * d), cov, atol=3.5 * math.sqrt(few) * cov.max())
    assert cloud_of(oracle).radius() == pytest.approx(
        math.sqrt(chi2.ppf(0.95, 2) * cov[0, 0]), rel=0.06
    )


def test_clock_given_the_path_is_a_kalman_filter() -> None:
    """With the place known, offset and drift are those of a two-state Kalman filter."""
    start = Start(
        mean=np.array([30.0, 40.0, 0.0, 0.0]),
        position_sd=1e-9,
        velocity_sd=1e-9,
        clock_mean=(0.0, 5.0),
        clock_sd=(3e4, 9.0),
    )
    oracle = ParticleFilter(start, Motion(accel=1e-9, clock=(0.3, 2.0)), 100, seed=1)
    x, P, dt, R = np.array([0.0, 5.0]), np.diag([9e8, 81.0]), 0.1, 9.0
    F, Q = np.array([[1, dt], [0, 1]]), 4 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    for k, value in enumerate(np.random.default_rng(2).normal(800.0, 3.0, 30)):
        if k > 0:
            oracle.predict(dt)
            x, P = F @ x, F @ P @ F.T + Q + np.diag([0.09 * dt, 0.0])
        oracle.update(row(Kind.TOA, value, 3.0)[None])
        K = P[:, 0] / (P[0, 0] + R)
        x, P = x + K * (value - 50.0 - x[0]), P - np.outer(K, P[0])
    np.testing.assert_allclose(oracle.clock.mean(axis=0), x, rtol=1e-6)
    np.testing.assert_allclose(oracle.clock_cov, P, rtol=1e-6)


def quadrature(prior_sd: float, rows: list[Array], variances: list[float]) -> Cloud:
    """Posterior of a place under a Gaussian prior about 0, by a fine grid."""
    side = np.linspace(-5 * prior_sd, 5 * prior_sd, 1201)
    x, y = (each.ravel() for each in np.meshgrid(side, side))
    total = -0.5 * (x**2 + y**2) / prior_sd**2
    for each, variance in zip(rows, variances, strict=True):
        dx, dy = x - each[3], y - each[4]
        if each[0] == Kind.PHASE:
            phase = each[5] * np.cos(np.arctan2(dy, dx) - each[6])
            e = (each[1] - phase + np.pi) % (2 * np.pi) - np.pi
        elif each[0] == Kind.FRONT:
            total = np.where(dx * math.cos(each[5]) + dy * math.sin(each[5]) > 0, total, -np.inf)
            continue
        else:
            e = each[1] - np.hypot(dx, dy)
        if each[0] == Kind.LATE_RANGE:
            lags = np.linspace(0.0, 30.0, 3001)
            table = np.linspace(e.min(), e.max(), 4001)
            late = np.exp(-lags / each[6]) / each[6]
            dense = norm.pdf(table[:, None], lags, each[2]) @ late * (lags[1] - lags[0])
            mixed = (1 - each[5]) * norm.pdf(e, 0, each[2]) + each[5] * np.interp(e, table, dense)
            total = total + np.log(np.maximum(mixed, 1e-300))
        else:
            total = total - 0.5 * e**2 / variance
    weights = np.exp(total - total.max())
    kept = weights > 1e-9
    return Cloud(np.column_stack([x, y])[kept], weights[kept] / weights[kept].sum())


PLACED = {
    "two ranges": [
        row(Kind.RANGE, 6.0, RANGE_SD, 1.0, 0.0),
        row(Kind.RANGE, 6.5, RANGE_SD, -1.0, 0.5),
    ],
    "two late ranges": [
        row(Kind.LATE_RANGE, 6.0, RANGE_SD, 1.0, 0.0, 0.3, 2.0),
        row(Kind.LATE_RANGE, 6.5, RANGE_SD, -1.0, 0.5, 0.3, 2.0),
    ],
    "range and phase": [
        row(Kind.RANGE, 4.0, RANGE_SD, 0.0, -0.5),
        row(Kind.PHASE, 0.7, 0.3, 0.0, 0.0, 8.0 * math.pi, -math.pi / 2.0),
        row(Kind.FRONT, 0.0, 1.0),
    ],
    "range and time": [
        row(Kind.RANGE, 6.0, RANGE_SD, 1.0, 0.0),
        row(Kind.TOA, 7.0, 0.4, -3.0, 4.0),
    ],
}


@pytest.mark.parametrize("rows", PLACED.values(), ids=PLACED)
def test_a_guided_update_agrees_with_quadrature(rows: list[Array]) -> None:
    clock_sd = 0.3
    start = Start(mean=np.zeros(4), position_sd=5.0, velocity_sd=1.0, clock_sd=(clock_sd, 0.0))
    oracle = ParticleFilter(start, Motion(accel=0.5), 20_000, seed=5)
    oracle.update(np.array(rows), guided=True)
    clock = [clock_sd**2 * (each[0] == Kind.TOA) for each in rows]
    exact = quadrature(5.0, rows, [r[2] ** 2 + c for r, c in zip(rows, clock, strict=True)])
    found = cloud_of(oracle)
    assert apart(found.mean, exact) < 0.05
    np.testing.assert_allclose(found.cov, exact.cov, atol=0.05 * np.trace(exact.cov))
    assert found.radius() == pytest.approx(exact.radius(), rel=0.05)
    modes = Modes(exact)
    drawn = np.random.default_rng(1).choice(len(found.xy), 20_000, p=found.weights)
    np.testing.assert_allclose(modes.shares_of(found.xy[drawn]), modes.weights, atol=0.03)


def test_the_late_range_has_the_moments_of_its_noise() -> None:
    """Normal noise, in three of ten cases plus an exponential excess."""
    late = row(Kind.LATE_RANGE, 0.0, RANGE_SD, 0.0, 0.0, 0.3, 2.0)

    def density(e: float, power: int = 0) -> float:
        late[1], weights = 10.0 + e, np.zeros(1)
        weigh(late, np.array([[10.0, 0.0, 0.0, 0.0]]), np.zeros((1, 2)), weights, 0.04, 0.0, 0.0)
        return float(e**power * math.exp(weights[0]))

    total, first, second = (
        quad(density, -2.0, 40.0, args=(k,), points=[0.0, 1.0], limit=200)[0] for k in range(3)
    )
    assert first / total == pytest.approx(0.6, rel=1e-4)
    assert second / total == pytest.approx(0.3 * 2.0 * 2.0**2 + RANGE_SD**2, rel=1e-4)


def test_modes_are_found_and_weighed() -> None:
    """Two blobs and a curved ridge: three modes with the shares they were drawn with."""
    rng = np.random.default_rng(8)
    angle = rng.uniform(0.0, 2.5, 50_000)
    arc = 10.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    blobs = np.vstack(
        [rng.normal(-8.0, 0.5, (30_000, 2)), rng.normal((9.0, -9.0), 1.0, (20_000, 2))]
    )
    xy = np.vstack([arc + rng.normal(0.0, 0.2, arc.shape), blobs])
    modes = Modes(Cloud(xy, np.full(len(xy), 1.0 / len(xy))))
    np.testing.assert_allclose(modes.weights, [0.5, 0.3, 0.2], atol=0.005)
    np.testing.assert_allclose(modes.shares_of(blobs[:30_000]), [0.0, 1.0, 0.0], atol=0.005)


def test_particles_that_explain_nothing_are_refused() -> None:
    oracle = ParticleFilter(
        Start(mean=np.array([-5.0, 0, 0, 0]), position_sd=0.1, velocity_sd=0.1),
        Motion(accel=0.1),
        100,
        seed=1,
    )
    with pytest.raises(ValueError, match="more particles"):
        oracle.update(row(Kind.FRONT, 0.0, 1.0)[None])


SHORT = {1: 0.34, 2: 0.25, 3: 0.34, 4: 0.2, 5: 0.34, 6: 0.25}
ENOUGH = {1: 1000, 2: 1000, 3: 1000, 4: 3000, 5: 6000, 6: 1000}


@pytest.mark.parametrize("problem", PROBLEMS)
def test_the_oracle_is_right_on_average(problem: int) -> None:
    """50 draws from the model: NEES, ranks of the truth and share in the 95 % circle."""
    particles, share = ENOUGH[problem], SHORT[problem]
    moments = [m for seed in range(500, 550) for m in alone(problem, seed, particles, share)]
    test = nees_test(moments, "nees")
    assert test is not None
    # 99.9 % where the bounds are 95 %: 18 figures must all pass.
    reach = 1.8 * (test.bounds[1] - 2.0)
    assert abs(test.mean - 2.0) < reach
    assert rank_p_value(moments) > 1e-3
    inside = np.mean([m.rank < 0.95 for m in moments])
    assert 0.85 < inside <= 1.0


@pytest.mark.parametrize("problem", [2, 6])
def test_twice_the_particles_change_nothing(problem: int) -> None:
    case = draw(problem, 3, SHORT[problem])
    clouds = []
    for particles in (3000, 6000):
        oracle, now = ParticleFilter(case.start, case.motion, particles, seed=particles), 0.0
        for step in case.steps:
            oracle.predict(step.time_s - now)
            now = step.time_s
            oracle.update(step.rows, guided=step.guided)
        clouds.append(cloud_of(oracle))
    assert apart(clouds[0].mean, clouds[1]) < 0.2
    assert clouds[0].radius() == pytest.approx(clouds[1].radius(), rel=0.2)


def test_the_script_compares_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document, figures = tmp_path / "page.md", tmp_path / "figures.json"
    document.write_text(f"Before.\n{BEGIN}\nold\n{END}\nAfter.\n", encoding="utf-8")
    tiny = ["--seeds", "2", "--particles", "300", "--share", "0.2", "--problem", "5"]
    out = ["--json", str(figures), "--document", str(document)]
    assert loaded("oracle").main([*tiny, *out]) == 0
    printed = capsys.readouterr().out
    assert f"Before.\n{BEGIN}\n{printed}{END}\nAfter.\n" == document.read_text(encoding="utf-8")
    told = json.loads(figures.read_text(encoding="utf-8"))
    (summary,) = told["problems"]
    assert summary["moments"] == len(told["moments"]) > 0
    errors = np.array([m["error"] for m in told["moments"]])
    assert summary["rmse"] == pytest.approx(math.sqrt(np.mean(errors**2)))


def test_a_page_without_marks_is_left_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("nothing\n", encoding="utf-8")
    with pytest.raises(ValueError, match="add both lines"):
        write_between_marks(page, "table")
    assert page.read_text(encoding="utf-8") == "nothing\n"


@pytest.mark.parametrize("bad", [["--problem", "7"], ["--seeds", "0"], ["--share", "2"]])
def test_the_script_refuses_bad_usage(bad: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        loaded("oracle").main(bad)
    assert stop.value.code == 2
