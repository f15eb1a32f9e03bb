"""Dead reckoning of simulated people with a module at the waist, against their true motion."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from netpos.inertial.gait import Gait, GaitModel
from netpos.inertial.gait import walk as walk_route
from netpos.inertial.imu import (
    ImuModel,
    MagneticDisturbance,
    MagnetometerModel,
    simulate_imu,
    simulate_magnetometer,
)
from netpos.inertial.magnetic_calibration import fit_iron
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_config import PdrConfig
from netpos.inertial.pdr_output import StepEvent, StepVelocity
from netpos.scenario import load_scenario
from netpos.world.routes import rectangle
from scipy.spatial.transform import Rotation


def heading_error(event: StepEvent, heading_deg: float) -> float:
    return abs(math.remainder(event.heading_rad - math.radians(heading_deg), 2 * math.pi))


def simulated(
    gait: Gait, seed: int, **magnetometer: Any
) -> tuple[Gait, list[StepEvent], list[StepVelocity], PedestrianDeadReckoning]:
    """A walking person's waist module through the core."""
    imu = simulate_imu(ImuModel(), gait, 10**9, seed, "v")
    model = MagnetometerModel(rate_hz=100.0, declination_deg=0.0, **magnetometer)
    stamps, field = simulate_magnetometer(model, gait, 10**9, seed, "v")
    core, events, velocities = PedestrianDeadReckoning(PdrConfig.of("waist")), [], []
    for i, stamp in enumerate(imu.stamp_ns.tolist()):
        out = core.add_imu(stamp, imu.angular_velocity[i], imu.specific_force[i])
        assert stamps[i + 1] == stamp
        core.add_magnetic_field(stamp, field[i + 1])
        events += out.steps if out else ()
        velocities += [out.velocity] if out and out.velocity else []
    return gait, events, velocities, core


PAPER_WALK = walk_route(
    rectangle((0.0, 0.0), 5.7, 4.5),
    GaitModel(cadence_hz=1 / 0.6375),
    pauses_s=[1.0, 0.7, 0.7, 0.7, 1.0],
)


def test_a_simulated_walk_is_counted_placed_and_headed() -> None:
    """Every foot contact within 0.1 s and no other; headings of the legs within 5 deg."""
    gait, events, _, core = simulated(PAPER_WALK, 7)
    ends = np.array([e.end_ns for e in events]) * 1e-9 - 1.0
    assert len(events) == gait.contact_s.size == 32
    np.testing.assert_allclose(ends, gait.contact_s, atol=0.1)
    straight = [e for e in events if abs(e.length_m / 0.6375 - 1) < 0.3]
    assert len(straight) >= 30
    for e, contact in zip(events, gait.contact_s, strict=True):
        before = gait.body_at(contact - 1 / gait.model.cadence_hz / 2).velocity[0]
        assert heading_error(e, math.degrees(math.atan2(before[1], before[0]))) < 0.25
    middle = [e for e, c in zip(events, gait.contact_s, strict=True) if 3 < c < 6.8]
    assert np.mean([heading_error(e, 0.0) for e in middle]) < math.radians(5)
    assert core.conditions == ()


@pytest.fixture(scope="module")
def whitened() -> list[np.ndarray]:
    """Velocity errors (n, 2) of four walks over their stated sd, starts, stops and turns
    included; one every 0.1 s."""
    walks = []
    for seed in range(4):
        gait, _, velocities, _ = simulated(PAPER_WALK, seed)
        truth = gait.body_at([v.stamp_ns * 1e-9 - 1.0 for v in velocities]).velocity[:, :2]
        errors = [
            np.linalg.solve(np.linalg.cholesky(v.covariance), v.velocity - true)
            for v, true in zip(velocities, truth, strict=True)
        ]
        walks.append(np.array(errors))
    return walks


def test_step_velocities_of_simulated_walks_are_consistent(whitened: list[np.ndarray]) -> None:
    """NEES of the velocity at every output; 2 expected."""
    nees = (np.concatenate(whitened) ** 2).sum(axis=1)
    assert 0.4 < np.mean(nees) < 2.5
    assert np.quantile(nees, 0.99) < 9.2


def test_how_long_errors_of_step_velocities_last(whitened: list[np.ndarray]) -> None:
    """Their power spectral density at 0 over the variance stated, by the sum of the correlations
    up to 2 s: what ``velocity_correlation_s`` of ``pedestrian_walk`` says."""
    count = sum(e.size for e in whitened)
    lags = [sum((e[k:] * e[: len(e) - k]).sum() for e in whitened) / count for k in range(21)]
    stated = load_scenario("pedestrian_walk").tracker["velocity_correlation_s"]
    assert 0.1 * (lags[0] + 2.0 * sum(lags[1:])) == pytest.approx(stated, rel=0.3)


def test_a_disturbed_field_leaves_the_heading_to_the_gyro() -> None:
    """Iron on the way turns the field by tens of degrees; without the gate the heading follows."""
    iron = MagneticDisturbance(center=(3.0, 0.0), radius_m=0.8, field_t=(25e-6, -10e-6, 20e-6))
    gait = walk_route([[0, 0], [12, 0]], GaitModel(), pauses_s=[2.0, 1.0])
    _, events, _, core = simulated(gait, 3, disturbances=(iron,))
    assert core.counters["magnetic_disturbed"] > 50
    assert max(heading_error(e, 0.0) for e in events[1:]) < math.radians(12)


def test_hard_iron_that_was_calibrated_does_not_turn_the_heading() -> None:
    """20 microtesla worn with the sensor: more than the horizontal field of 15."""
    gait = walk_route([[0, 0], [6, 0]], GaitModel(), pauses_s=[2.0, 1.0])
    imu = simulate_imu(ImuModel(), gait, 10**9, 2, "v")
    model = MagnetometerModel(rate_hz=100.0, declination_deg=0.0, noise_sd_t=0.0)
    iron = MagnetometerModel(
        rate_hz=100.0,
        declination_deg=0.0,
        noise_sd_t=0.0,
        hard_iron_sd_t=20e-6,
        soft_iron_sd=0.05,
    )
    clean = simulate_magnetometer(model, gait, 10**9, 2, "v")[1]
    worn = simulate_magnetometer(iron, gait, 10**9, 2, "v")[1]
    turned = Rotation.random(300, rng=np.random.default_rng(4)).apply(clean[0])
    design = np.hstack([clean, np.ones((len(clean), 1))])
    linear = np.linalg.lstsq(design, worn, rcond=None)[0]  # what this sensor makes of a field
    fit = fit_iron(turned @ linear[:3] + linear[3])
    errors = {}
    for name, config in (
        ("raw", PdrConfig.of("waist")),
        (
            "calibrated",
            PdrConfig.from_mapping(
                {
                    "placement": "waist",
                    "hard_iron_t": fit.offset.tolist(),
                    "field_matrix": fit.matrix.ravel().tolist(),
                }
            ),
        ),
    ):
        core, events = PedestrianDeadReckoning(config), []
        for i, stamp in enumerate(imu.stamp_ns.tolist()):
            out = core.add_imu(stamp, imu.angular_velocity[i], imu.specific_force[i])
            core.add_magnetic_field(stamp, worn[i + 1])
            events += out.steps if out else ()
        errors[name] = np.median([heading_error(e, 0.0) for e in events])
    assert errors["raw"] > math.radians(12)
    assert errors["calibrated"] < math.radians(5)
