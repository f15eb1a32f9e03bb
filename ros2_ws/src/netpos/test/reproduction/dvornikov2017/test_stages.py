"""The stages of one object over a run against per-axis filters written out in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from netpos.messages.values import Array
from netpos.reproduction.dvornikov2017.paper import DEAF, FLOORED, JERKY, PAPER, WIFI, WIMAX
from netpos.reproduction.dvornikov2017.pictures import gains_of
from netpos.reproduction.dvornikov2017.stages import (
    CENTRAL,
    Pass,
    Setting,
    Stages,
    errors_of_seeds,
)
from netpos.reproduction.dvornikov2017.truth import START_NS, Jerky, crossing
from netpos.tracking.config import TrackerConfig

NS = 1_000_000_000
FLOOR = np.array([0.0926, 0.008, 0.0003])


def per_axis(
    times: Array, fixes: Array, variances: Array, start: Array, floor: Array, jerk: float
) -> tuple[Array, Array, Array]:
    """Means (n, 3), covariances (n, 3, 3) and gains (n, 3) of dvornikov2017:eq.4-6 on one axis,
    the covariance in Joseph's form."""
    x, P, before = start.copy(), 1e3 * np.eye(3), 0.0
    means, covs, gains = [], [], []
    for t, u, r in zip(times, fixes, variances, strict=True):
        dt = t - before
        F = np.array([[1.0, dt, dt * dt / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
        b = np.array([dt**2 / 2, dt, 1.0])
        nodes, weights = np.polynomial.legendre.leggauss(4)
        Q = np.zeros((3, 3))
        for node, weight in zip(nodes, weights, strict=True):  # white jerk, by quadrature
            s = dt * (node + 1) / 2
            g = np.array([s * s / 2, s, 1.0])
            Q += jerk**2 * dt / 2 * weight * np.outer(g, g)
        assert b[2] == 1.0
        x, P = F @ x, F @ P @ F.T + Q
        K = np.maximum(P[:, 0] / (P[0, 0] + r), floor)
        A = np.eye(3) - np.outer(K, [1.0, 0.0, 0.0])
        x, P = x + K * (u - x[0]), A @ P @ A.T + r * np.outer(K, K)
        before = t
        means.append(x)
        covs.append(P)
        gains.append(K)
    return np.array(means), np.array(covs), np.array(gains)


@pytest.mark.parametrize(
    ("config", "floor", "jerk"),
    [(FLOORED, FLOOR, 0.0), (DEAF, np.zeros(3), 0.0), (JERKY, np.zeros(3), 0.3)],
)
@pytest.mark.parametrize("networks", [(WIFI,), (WIMAX, WIFI)])
def test_secondary_stage_is_the_papers_filter(
    config: TrackerConfig, floor: Array, jerk: float, networks: tuple[object, ...]
) -> None:
    setting = replace(PAPER, tracker=config, duration_s=60.0)
    stage = Pass(setting, networks)  # type: ignore[arg-type]
    truth = setting.truth(3, stage.stamps_ns)
    fixes = stage.fixes(3, truth)
    start = setting.truth(3, np.array([START_NS]))[0] + 5.0
    means, covs = stage.run(fixes, start)
    times = (stage.stamps_ns - START_NS) / NS
    sd = {0: 3.0, 1: 10.0} if len(networks) == 2 else {0: 10.0}
    variances = np.array([sd[int(i)] ** 2 for i in stage._which])
    for axis in range(2):
        mine = [axis, axis + 2, axis + 4]
        expected = per_axis(times, fixes[:, axis], variances, start[mine], floor, jerk)
        np.testing.assert_allclose(means[:, mine], expected[0], rtol=1e-7, atol=1e-6)
        np.testing.assert_allclose(
            covs[np.ix_(np.arange(len(covs)), mine, mine)], expected[1], rtol=1e-6, atol=1e-8
        )
        if axis == 0:
            gains = gains_of(stage, jerk, fixes, start)
            np.testing.assert_allclose(gains, expected[2], rtol=1e-4, atol=1e-7)


def test_gains_rest_on_the_floor() -> None:
    """Fig. 6: near 1 at first, on the floor at the end."""
    stage = Pass(PAPER, [WIFI])
    truth = PAPER.truth(1, stage.stamps_ns)
    start = PAPER.truth(1, np.array([START_NS]))[0]
    gains = gains_of(stage, 0.0, stage.fixes(1, truth), start)
    assert gains[0, 0] == pytest.approx(1000 / 1100)
    np.testing.assert_allclose(gains[-1], FLOOR, rtol=1e-4)


@pytest.fixture(scope="module")
def short() -> Setting:
    return Setting(
        name="short",
        networks=(WIMAX, WIFI),
        tracker=JERKY,
        truth=Jerky((10.0, 5.0), 0.3, 20.0),
        duration_s=20.0,
        start_var=4.0,
    )


def test_spread_over_seeds_is_what_every_estimator_claims(short: Setting) -> None:
    """... but for the fusion that takes the networks for independent: it claims too much."""
    built = Stages(short)
    errors = errors_of_seeds(short, range(6000, 6150))
    late = built.time_s >= 5.0
    ratio = {}
    for name, error in errors.items():
        P = built.covs[name][late]
        e = error[:, late]
        ratio[name] = float(np.einsum("rni,nij,rnj->rn", e, np.linalg.inv(P), e).mean()) / 2.0
    for name in ("wimax", "wifi", CENTRAL):
        assert ratio[name] == pytest.approx(1.0, abs=0.07)
    assert ratio["split_ci"] <= 1.07
    assert ratio["independent"] > ratio["split_ci"] + 0.05


def test_centralised_without_floor_is_the_bound(short: Setting) -> None:
    built = Stages(short)
    trace = {name: np.trace(cov[-1]) for name, cov in built.covs.items()}
    assert trace[CENTRAL] < trace["split_ci"] < trace["ci"] <= trace["wimax"] * (1 + 1e-6)
    assert trace["independent"] < trace["split_ci"]


def test_jerky_truth_walks_as_the_filter_takes_it_to() -> None:
    """The acceleration of many seeds after 4 s: variance jerk^2 t."""
    truth = Jerky((1.0, 0.0), 0.5, 5.0)
    end = np.array([truth(seed, np.array([START_NS + 4 * NS]))[0] for seed in range(300)])
    np.testing.assert_allclose(end[:, 4:].var(axis=0), 1.0, rtol=0.3)
    np.testing.assert_allclose(end[:, 0].mean(), 4.0, atol=1.0)
    again = truth(7, np.array([START_NS, START_NS + NS]))
    np.testing.assert_array_equal(again, truth(7, START_NS + np.array([0, NS])))


def test_crossing_objects_meet() -> None:
    for seed in range(5):
        ways = crossing(seed, 5, 20.0, 30.0, (8.0, 12.0))
        stamps = START_NS + np.arange(0, 41) * NS
        paths = np.array([way(seed, stamps)[:, :2] for way in ways])
        apart = np.linalg.norm(paths[:, None] - paths[None], axis=3).min(axis=2)
        assert (np.sort(apart, axis=1)[:, 1] < 20.0).all()  # the nearest other one
        assert np.abs(paths[:, 20]).max() < 60.0
        assert np.linalg.norm(paths[:, 0], axis=1).min() > 100.0
