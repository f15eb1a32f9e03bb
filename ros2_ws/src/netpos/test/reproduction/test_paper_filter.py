"""The paper's filter against FilterPy, equation by equation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from netpos.estimation.measurement import AXES, BIAS, KIND, ORIGIN, VALUE, VARIANCE, Kind
from netpos.estimation.state import POSITION, VELOCITY, X
from netpos.messages.values import Array
from netpos.reproduction.experiment import VUE, Experiment, Setup
from netpos.reproduction.paper_filter import LOST_M, PaperNoise, run_paper_filter
from netpos.scenario import Simulation, load_scenario
from netpos.tracking import TrackerConfig
from netpos.tracking.estimators.models import pose_state

C = 299_792_458.0
CHANGES = {"max_duration_s": 60.0}
PAPER = Experiment(
    name="METIS", scenario="metis_madrid", changes=tuple(CHANGES.items()), estimator="paper"
)


@pytest.fixture(scope="module")
def route() -> dict[str, Any]:
    """A minute of METIS with its turn: measurements per epoch in the order of the rows' RSUs."""
    setup = Setup(PAPER)
    scenario = load_scenario("metis_madrid", changes=CHANGES)
    simulation = Simulation(scenario)
    config = TrackerConfig.from_mapping(dict(scenario.tracker))
    pose = simulation.initial_pose(VUE)
    assert pose is not None
    mean, cov = pose_state(config, pose.position[:2], pose.cov[:2, :2])
    _, epochs = setup._epochs(simulation)
    return {"epochs": epochs, "mean": mean, "cov": cov, "simulation": simulation}


def _filterpy(route: dict[str, Any], noise: PaperNoise) -> tuple[Array, Array]:
    """Means and covariances of FilterPy with F of eq. 35, Q of eq. 4 and 36, H of eq. 44."""
    epochs = route["epochs"]
    ekf = ExtendedKalmanFilter(dim_x=6, dim_z=4)
    ekf.x, ekf.P = route["mean"].copy(), route["cov"].copy()
    means, covs = [], []
    for k, stamp in enumerate(epochs.stamps_ns):
        if k:
            dt = (stamp - epochs.stamps_ns[k - 1]) * 1e-9
            F = np.eye(6)
            F[X.PX, X.VX] = F[X.PY, X.VY] = F[X.CLOCK, X.DRIFT] = dt
            G = np.zeros((6, 2))
            G[:4] = np.vstack([dt**2 / 2 * np.eye(2), dt * np.eye(2)])
            step = noise.velocity_sd_mps**2
            Q = np.diag([0.0, 0.0, step, step, 0.0, (C * noise.drift_sd) ** 2])
            ekf.F, ekf.Q = F, Q + noise.accel_sd_mps2**2 * G @ G.T
            ekf.predict()
        rows = epochs.rows[epochs.row_start[k] : epochs.row_start[k + 1]]
        site, angle = rows[:, ORIGIN : ORIGIN + 2], rows[:, KIND] == Kind.AZIMUTH

        def measured(x: Array, site: Array = site, angle: Array = angle) -> Array:
            dx, dy = (x[POSITION] - site).T
            return np.where(angle, np.arctan2(dy, dx), np.hypot(dx, dy) + x[X.CLOCK])

        def slopes(x: Array, site: Array = site, angle: Array = angle) -> Array:
            dx, dy = (x[POSITION] - site).T
            r = np.hypot(dx, dy)
            H = np.zeros((len(site), 6))
            H[:, 0] = np.where(angle, -dy / r**2, dx / r)
            H[:, 1] = np.where(angle, dx / r**2, dy / r)
            H[:, 4] = ~angle
            return H

        def residual(a: Array, b: Array, angle: Array = angle) -> Array:
            difference = a - b
            wrapped = (difference + np.pi) % (2 * np.pi) - np.pi
            return np.where(angle, wrapped, difference)

        R = np.diag(rows[:, VARIANCE])
        ekf._I = np.eye(6)
        ekf.update(rows[:, VALUE], slopes, measured, R=R, residual=residual)
        means.append(ekf.x.copy())
        covs.append(ekf.P.copy())
    return np.array(means), np.array(covs)


@pytest.mark.parametrize(
    "noise",
    [PaperNoise(), PaperNoise(velocity_sd_mps=0.0, accel_sd_mps2=2.0, drift_sd=1e-6)],
)
def test_it_is_the_textbook_filter(route: dict[str, Any], noise: PaperNoise) -> None:
    done, means, covs = run_paper_filter(*route["epochs"][:3], route["mean"], route["cov"], noise)
    expected, expected_covs = _filterpy(route, noise)
    assert done == len(expected) > 600
    np.testing.assert_allclose(means[:, POSITION], expected[:, :2], rtol=0, atol=1e-5)
    np.testing.assert_allclose(means[:, VELOCITY], expected[:, 2:4], rtol=0, atol=1e-5)
    np.testing.assert_allclose(means[:, X.CLOCK], expected[:, 4], rtol=0, atol=1e-4)
    transient_covs, expected_transient = covs[20:, :4, :4], expected_covs[20:, :4, :4]
    np.testing.assert_allclose(transient_covs, expected_transient, rtol=1e-3, atol=1e-6)


def test_a_run_starts_from_the_pose_and_sees_the_measurements_of_ours(
    route: dict[str, Any],
) -> None:
    track = Setup(PAPER).run(route["simulation"].scenario.seed)
    _, means, _ = run_paper_filter(*route["epochs"][:3], route["mean"], route["cov"], PaperNoise())
    np.testing.assert_array_equal(track.mean, means)
    assert track.losses == 0
    assert track.tracked.all()
    assert np.isnan(track.level).all()


def test_a_lost_run_counts_for_nothing() -> None:
    """Without a position to start from the filter does not find the street."""
    far = ("devices.0.initial_pose_sd_m", 500.0)
    setup = Setup(replace(PAPER, changes=(*PAPER.changes, far)))
    lost = [track for track in map(setup.run, range(100_000, 100_010)) if track.losses]
    assert lost
    for track in lost:
        assert not track.tracked.any()
        assert np.isnan(track.mean).all()
    assert LOST_M == 30.0  # half the distance of neighbouring RSUs


def test_section_3_has_the_noise_of_its_own_model() -> None:
    """fast_pass names white acceleration, eq. 36: 1 m/s^2 a step."""
    changes = (("devices.0.initial_pose_sd_m", 5.0),)
    setup = Setup(Experiment(name="x", scenario="fast_pass", changes=changes, estimator="paper"))
    track = setup.run(1)
    simulation = setup.simulation.with_seed(1)
    start, (_, epochs) = setup._start(simulation), setup._epochs(simulation)
    noise = PaperNoise(velocity_sd_mps=0.0, accel_sd_mps2=1.0, drift_sd=1e-4)
    np.testing.assert_array_equal(track.mean, run_paper_filter(*epochs[:3], *start, noise)[1])


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (KIND, float(Kind.RANGE), "azimuths and TOA only"),
        (AXES, -1.0, "axes of the map"),
        (ORIGIN + 2, 3.0, "in the plane"),
        (BIAS, 6.0, "no biases"),
    ],
)
def test_what_it_does_not_know_is_refused(
    route: dict[str, Any], column: int, value: float, message: str
) -> None:
    stamps_ns, row_start, rows = route["epochs"][:3]
    rows = rows.copy()
    rows[5, column] = value
    with pytest.raises(ValueError, match=message):
        run_paper_filter(stamps_ns, row_start, rows, route["mean"], route["cov"], PaperNoise())
