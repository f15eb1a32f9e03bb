"""The one default parameter set on public recordings (see ../shared/data/README.md).

The data are not redistributed: set NETPOS_DATA, or keep them in ``<repo>/../shared/data``.
"""

from __future__ import annotations

import itertools
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from netpos.evaluation.pedestrian import (
    ContactScore,
    PdrRun,
    heading_and_tilt_error,
    run_core,
    score_contacts,
    score_walk,
)
from netpos.inertial import loaders
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_config import PdrConfig, Placement
from netpos.inertial.pdr_output import StepEvent
from netpos.messages.values import Velocity
from netpos.tracking.door.repeats import Repeats
from vqf import VQF

Array = np.ndarray


def data_file(relative: str) -> Path:
    default = Path(__file__).resolve().parents[5].parent / "shared" / "data"
    path = Path(os.environ.get("NETPOS_DATA", default)) / relative
    if not path.is_file():
        pytest.skip(f"{path} is absent: set NETPOS_DATA to the folder of recorded data")
    return path


def run(imu: loaders.ImuRecord, placement: Placement = "carried", magnetic: bool = True) -> PdrRun:
    core = PedestrianDeadReckoning(PdrConfig.of(placement))
    return run_core(imu, core, with_magnetometer=magnetic)


@pytest.mark.parametrize(
    ("name", "total"),
    [("user1_bag", 346), ("user1_frontpocket", 327), ("user2_hand", 340), ("user2_armband", 343)],
)
def test_phone_step_count_within_one_percent(name: str, total: int) -> None:
    record = loaders.load_steps_phone(data_file(f"steps_phone/{name}.csv"))
    assert record.true_step_ns.size == total
    got = run(record.imu)
    assert abs(len(got.events) - total) <= 0.01 * total
    assert got.core.counters == {}
    assert got.core.conditions == ("no_magnetic_field",)


@pytest.mark.parametrize(
    ("name", "entries", "expected"),
    [("HA_001", 63, ContactScore(63, 61, 3, 1)), ("HA_002", 54, ContactScore(46, 38, 5, 8))],
)
def test_waist_initial_contacts(name: str, entries: int, expected: ContactScore) -> None:
    """Slow, hard gait, pinned. 95 % found, 5 % false are met on HA_001 only."""
    record = loaders.load_waist_imu(data_file(f"waist_imu/{name}/data.mat"))
    assert record.contact_entries == entries
    got = run(record.imu, "waist")
    score = score_contacts([e.end_ns for e in got.events], record.bouts)
    assert score.listed == expected.listed
    assert score.found >= expected.found
    assert score.false <= expected.false
    assert score.unlisted <= sum(n for b in record.bouts for *_, n in b.untimed)


def test_untimed_contacts_are_those_listed_without_time_or_skipped_by_a_foot(
    tmp_path: Path,
) -> None:
    nan = math.nan
    bout = {
        "Start": 1.0,
        "End": 9.0,
        "Length": 4.0,
        "InitialContact_Event": [1.0, 2.0, nan, 4.0, 5.0, nan, 7.0, 8.0, 9.0],
        "InitialContact_LeftRight": np.array(
            ["Left", "Right", "Left", "Right", "Right", "Left", "Left", "Right", "Left"],
            dtype=object,
        ),
    }
    sensor = {
        "Timestamp": np.arange(3.0),
        "Acc": np.ones((3, 3)),
        "Gyr": np.ones((3, 3)),
        "Mag": np.ones((3, 3)),
    }
    trial = {
        "SU": {"LowerBack": sensor},
        "Standards": {"INDIP": {"MicroWB": np.array([bout, bout], dtype=object)}},
    }
    path = tmp_path / "data.mat"
    scipy.io.savemat(path, {"data": {"TimeMeasure1": {"Test11": {"Trial1": trial}}}})
    record = loaders.load_waist_imu(path)
    slots = [(round(a * 1e-9), round(b * 1e-9), n) for a, b, n in record.bouts[0].untimed]
    assert slots == [(2, 4, 1), (4, 5, 1), (5, 7, 2)]
    assert len(record.bouts) == 2


def test_waist_mapping_is_flu_and_right_handed() -> None:
    """Mean specific force is up; gravity in the body turns as f' = -w x f (tilt only)."""
    record = loaders.load_waist_imu(data_file("waist_imu/HA_001/data.mat"))
    force, rate = record.imu.specific_force, record.imu.angular_velocity
    assert rate is not None
    assert force.mean(axis=0)[2] > 0.9 * np.linalg.norm(force.mean(axis=0))
    box = np.ones(50) / 50
    f = np.stack([np.convolve(force[:, i], box, "same") for i in range(3)], axis=1)
    w = np.stack([np.convolve(rate[:, i], box, "same") for i in range(3)], axis=1)
    seen, model = np.gradient(f, 0.01, axis=0), -np.cross(w, f)
    for axis in (0, 1):
        assert np.corrcoef(seen[100:-100, axis], model[100:-100, axis])[0, 1] > 0.5


@pytest.mark.parametrize("magnetic", [False, True])
def test_phone_walk_shape_and_distance(magnetic: bool) -> None:
    """3 % of the path, for the distance and at every way-point (best turn and shift, no scale)."""
    record = loaders.load_pdr_phone(data_file("pdr_phone/site1_F1.txt"))
    got = run(record.imu, magnetic=magnetic)
    score = score_walk(got.events, record)
    assert score.true_distance_m == pytest.approx(122.9, abs=0.1)
    assert score.distance_m == pytest.approx(score.true_distance_m, rel=0.03)
    assert score.steps == pytest.approx(179, rel=0.05)
    assert score.rmse_m < 0.02 * score.true_distance_m
    if not magnetic:
        assert score.max_m < 0.03 * score.true_distance_m
        return
    # The field of this building turns by tens of degrees, for every filter that follows it.
    package = score_walk(with_heading_of_vqf(got, record.imu), record)
    assert score.max_m < package.max_m
    assert score.rmse_m < 1.05 * package.rmse_m
    # the axes of the loader and the field agree with the surveyed map
    assert abs(math.degrees(score.turn_rad)) < 15.0


def with_heading_of_vqf(got: PdrRun, imu: loaders.ImuRecord) -> list[StepEvent]:
    """The steps with the headings that the package's own filter of nine axes gives."""
    assert imu.angular_velocity is not None
    assert imu.magnetic_field is not None
    filter_ = VQF(float(np.median(np.diff(imu.stamp_ns))) * 1e-9)
    samples = (imu.angular_velocity, imu.specific_force, imu.magnetic_field)
    attitude = filter_.updateBatch(*map(np.ascontiguousarray, samples))["quat9D"]
    turned = yaw_of(attitude) - yaw_of(got.attitude)
    return [
        replace(e, heading_rad=e.heading_rad + float(np.interp(e.end_ns, imu.stamp_ns, turned)))
        for e in got.events
    ]


def yaw_of(quaternion: Array) -> Array:
    """(n,) rad, without jumps; (n, 4) w x y z."""
    w, x, y, z = quaternion.T
    return np.unwrap(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))


@pytest.mark.parametrize(
    ("name", "magnetic", "limit_deg"),
    [
        ("04_undisturbed_slow_rotation_with_breaks_A", True, 1.5),
        ("04_undisturbed_slow_rotation_with_breaks_A", False, 8.0),
        ("15_undisturbed_fast_translation_A", True, 2.5),
        ("15_undisturbed_fast_translation_A", False, 4.0),
    ],
)
def test_attitude_against_optical_reference(name: str, magnetic: bool, limit_deg: float) -> None:
    """Without a magnetometer the start heading is 0 by accident."""
    record = loaders.load_imu_mag_attitude(data_file(f"imu_mag_attitude/{name}.mat"))
    got = run(record.imu, magnetic=magnetic)
    use = record.moving & np.all(np.isfinite(record.quaternion), axis=1)
    errors = heading_and_tilt_error(got.attitude[use], record.quaternion[use])
    heading, tilt = (float(np.degrees(np.sqrt(np.mean(e**2)))) for e in errors)
    assert heading < limit_deg
    assert tilt < 1.5


@pytest.mark.parametrize(
    ("relative", "placement"),
    [
        ("steps_phone/user2_armband.csv", "carried"),
        ("waist_imu/HA_001/data.mat", "waist"),
        ("waist_imu/HA_002/data.mat", "waist"),
        ("pdr_phone/site1_F1.txt", "carried"),
    ],
)
def test_a_velocity_is_never_repeated_with_its_covariance(
    relative: str, placement: Placement
) -> None:
    """Only rest is: a step is held, but its covariance grows. So no honest step looks stuck."""
    path = data_file(relative)
    load = getattr(loaders, f"load_{Path(relative).parts[0]}")
    imu = load(path).imu
    rates = np.zeros_like(imu.specific_force)
    rates = imu.angular_velocity if imu.angular_velocity is not None else rates
    core, repeats, said = PedestrianDeadReckoning(PdrConfig.of(placement)), Repeats(), []
    for stamp, rate, force in zip(imu.stamp_ns.tolist(), rates, imu.specific_force, strict=True):
        out = core.add_imu(stamp, rate, force)
        if out is None or out.velocity is None:
            continue
        velocity, cov = out.velocity.velocity, out.velocity.covariance
        said.append((*velocity.tolist(), *cov.ravel().tolist()))
        reported = Velocity(stamp_ns=stamp, vue_id="v", velocity=velocity, cov=cov)
        assert not repeats.stuck(reported)
    moving = [v for v in said if any(v[:2])]
    assert len(moving) > 500
    assert len(set(moving)) == len(moving)
    assert sum(a == b for a, b in itertools.pairwise(said)) > 90  # at rest


def test_loaders_name_an_absent_path(tmp_path: Path) -> None:
    for load in (
        loaders.load_waist_imu,
        loaders.load_steps_phone,
        loaders.load_pdr_phone,
        loaders.load_imu_mag_attitude,
    ):
        with pytest.raises(FileNotFoundError, match="nowhere"):
            load(tmp_path / "nowhere")


def test_loaders_name_a_malformed_path(tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    broken.write_text("1574562661934\tTYPE_ACCELEROMETER\tx\ty\tz\n")
    for load in (
        loaders.load_waist_imu,
        loaders.load_steps_phone,
        loaders.load_pdr_phone,
        loaders.load_imu_mag_attitude,
    ):
        with pytest.raises(ValueError, match="broken"):
            load(broken)
