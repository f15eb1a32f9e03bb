"""The one default parameter set on public recordings (see ../shared/data/README.md).

The data are not redistributed: set NETPOS_DATA, or keep them in ``<repo>/../shared/data``.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from netpos.inertial import loaders
from netpos.inertial.pdr import PedestrianDeadReckoning, StepEvent
from scipy.spatial.transform import Rotation

TOLERANCE_NS = 150_000_000


def data_file(relative: str) -> Path:
    default = Path(__file__).resolve().parents[5].parent / "shared" / "data"
    path = Path(os.environ.get("NETPOS_DATA", default)) / relative
    if not path.is_file():
        pytest.skip(f"{path} is absent: set NETPOS_DATA to the folder of recorded data")
    return path


def run(
    imu: loaders.ImuRecord, magnetic: bool = True
) -> tuple[PedestrianDeadReckoning, list[StepEvent], np.ndarray]:
    """-> core, events, (n, 4) attitude w x y z after each sample."""
    core, attitude = PedestrianDeadReckoning(), []
    events: list[StepEvent] = []
    zero = np.zeros_like(imu.specific_force)
    rate = imu.angular_velocity if imu.angular_velocity is not None else zero
    for i, stamp in enumerate(imu.stamp_ns.tolist()):
        out = core.add_imu(stamp, rate[i], imu.specific_force[i])
        if magnetic and imu.magnetic_field is not None:
            core.add_magnetic_field(stamp, imu.magnetic_field[i])
        events += out.steps if out else ()
        attitude.append(core.attitude.quaternion)
    return core, events, np.array(attitude)


def match(found_ns: np.ndarray, contact_ns: np.ndarray) -> int:
    """Reference contacts with an own detection within the tolerance (greedy, in time)."""
    left, hits = sorted(found_ns.tolist()), 0
    for contact in np.sort(contact_ns).tolist():
        near = [f for f in left if abs(f - contact) <= TOLERANCE_NS]
        if near:
            left.remove(min(near, key=lambda f: abs(f - contact)))
            hits += 1
    return hits


@pytest.mark.parametrize(
    ("name", "total"),
    [("user1_bag", 346), ("user1_frontpocket", 327), ("user2_hand", 340), ("user2_armband", 343)],
)
def test_phone_step_count_within_one_percent(name: str, total: int) -> None:
    record = loaders.load_steps_phone(data_file(f"steps_phone/{name}.csv"))
    assert record.true_step_ns.size == total
    core, events, _ = run(record.imu)
    assert abs(len(events) - total) <= 0.01 * total
    assert core.counters == {}


@pytest.mark.parametrize(
    ("name", "entries", "usable", "hits", "false"),
    [("HA_001", 63, 63, 60, 6), ("HA_002", 54, 46, 32, 20)],
)
def test_waist_initial_contacts(
    name: str, entries: int, usable: int, hits: int, false: int
) -> None:
    """Slow, hard gait. HA_002 lists 8 NaN; most misses there have no vertical signature."""
    record = loaders.load_waist_imu(data_file(f"waist_imu/{name}/data.mat"))
    assert record.contact_entries == entries
    _, events, _ = run(record.imu)
    found = np.array([e.end_ns for e in events])
    got = wrong = listed = 0
    for bout in record.bouts:
        first = bout.start_ns - TOLERANCE_NS
        last = max(bout.initial_contact_ns[-1], bout.start_ns) + TOLERANCE_NS
        inside = found[(found > first) & (found < last)]
        n = match(inside, bout.initial_contact_ns)
        got, wrong, listed = (
            got + n,
            wrong + inside.size - n,
            listed + bout.initial_contact_ns.size,
        )
    assert listed == usable
    assert got >= hits
    assert wrong <= false


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


@pytest.mark.parametrize(("magnetic", "limit_m"), [(False, 1.5), (True, 2.3)])
def test_phone_walk_shape_and_distance(magnetic: bool, limit_m: float) -> None:
    """RMSE at 17 waypoints after the best rotation and translation (no scale)."""
    record = loaders.load_pdr_phone(data_file("pdr_phone/site1_F1.txt"))
    _, events, _ = run(record.imu, magnetic)
    xy = np.cumsum(
        [[e.length_m * np.cos(e.heading_rad), e.length_m * np.sin(e.heading_rad)] for e in events],
        axis=0,
    )
    truth = record.waypoint_m
    walked = float(np.sum(np.linalg.norm(np.diff(truth, axis=0), axis=1)))
    assert walked == pytest.approx(122.9, abs=0.1)
    assert sum(e.length_m for e in events) == pytest.approx(walked, rel=0.02)
    assert len(events) == pytest.approx(179, rel=0.05)
    ends = np.array([e.end_ns for e in events])
    at = np.stack([np.interp(record.waypoint_ns, ends, xy[:, i]) for i in (0, 1)], axis=1)
    a, b = at - at.mean(axis=0), truth - truth.mean(axis=0)
    turn = np.angle(np.sum((b @ [1, 1j]) * np.conj(a @ [1, 1j])))
    if magnetic:  # the axes of the loader and the field agree with the surveyed map
        assert abs(float(np.degrees(turn))) < 15.0
    aligned = (a @ [1, 1j]) * np.exp(1j * turn)
    assert float(np.sqrt(np.mean(np.abs(aligned - b @ [1, 1j]) ** 2))) < limit_m


@pytest.mark.parametrize(("magnetic", "limit_deg"), [(True, 2.0), (False, 8.0)])
def test_attitude_against_optical_reference(magnetic: bool, limit_deg: float) -> None:
    """Undisturbed slow rotation; without a magnetometer the start heading is 0 by accident."""
    name = "imu_mag_attitude/04_undisturbed_slow_rotation_with_breaks_A.mat"
    record = loaders.load_imu_mag_attitude(data_file(name))
    _, _, attitude = run(record.imu, magnetic)
    use = record.moving & np.all(np.isfinite(record.quaternion), axis=1)
    ours = Rotation.from_quat(attitude[use][:, [1, 2, 3, 0]])
    error = (ours * Rotation.from_quat(record.quaternion[use][:, [1, 2, 3, 0]]).inv()).as_quat()
    heading = 2 * np.degrees(np.arctan(error[:, 2] / error[:, 3]))
    tilt = 2 * np.degrees(np.arcsin(np.minimum(np.hypot(error[:, 0], error[:, 1]), 1.0)))
    assert float(np.sqrt(np.mean(heading**2))) < limit_deg
    assert float(np.sqrt(np.mean(tilt**2))) < 1.5


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
