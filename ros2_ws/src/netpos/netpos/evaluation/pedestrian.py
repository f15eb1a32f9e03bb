"""Scores of dead reckoning against references: contacts, distance, way-points, heading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from netpos.inertial.loaders import ImuRecord, WalkingBout, WaypointRecord
from netpos.inertial.pdr import PedestrianDeadReckoning
from netpos.inertial.pdr_output import StepEvent

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

CONTACT_TOLERANCE_NS = 150_000_000


@dataclass(frozen=True, slots=True)
class PdrRun:
    """A recording through the core. attitude (n, 4) w x y z after each sample."""

    core: PedestrianDeadReckoning
    events: tuple[StepEvent, ...]
    attitude: Array


@dataclass(frozen=True, slots=True)
class ContactScore:
    """Detections against reference contacts, inside the reference's bouts.

    listed, found : contacts with a time; those with a detection of their own within the tolerance
    false : detections that belong to no contact
    unlisted : further detections where the reference has a contact without a time, at most one
        for each of them
    """

    listed: int
    found: int
    false: int
    unlisted: int


@dataclass(frozen=True, slots=True)
class WalkScore:
    """A dead-reckoned walk against way-points, after the best turn and shift (no scale) [m]."""

    steps: int
    distance_m: float
    true_distance_m: float
    rmse_m: float
    max_m: float
    turn_rad: float


def run_core(
    imu: ImuRecord, core: PedestrianDeadReckoning, *, with_magnetometer: bool = True
) -> PdrRun:
    """Feed a whole recording; one without a gyro has rates of 0."""
    attitude = np.empty((len(imu.stamp_ns), 4))
    events: list[StepEvent] = []
    rates = imu.angular_velocity
    if rates is None:
        rates = np.zeros_like(imu.specific_force)
    for i, stamp in enumerate(imu.stamp_ns.tolist()):
        out = core.add_imu(stamp, rates[i], imu.specific_force[i])
        if with_magnetometer and imu.magnetic_field is not None:
            core.add_magnetic_field(stamp, imu.magnetic_field[i])
        events += out.steps if out else ()
        attitude[i] = core.attitude.quaternion
    return PdrRun(core, tuple(events), attitude)


def score_contacts(detected_ns: npt.ArrayLike, bouts: Sequence[WalkingBout]) -> ContactScore:
    """Match each contact to its nearest free detection, in order of time.

    Only detections between the first and the last contact of a bout count, the tolerance added.
    """
    detected = np.sort(np.asarray(detected_ns, dtype=np.int64))
    totals = np.zeros(4, dtype=int)
    for bout in bouts:
        contacts = bout.initial_contact_ns
        first, last = contacts[0] - CONTACT_TOLERANCE_NS, contacts[-1] + CONTACT_TOLERANCE_NS
        free = detected[(detected > first) & (detected < last)].tolist()
        hits = 0
        for contact in contacts.tolist():
            near = [f for f in free if abs(f - contact) <= CONTACT_TOLERANCE_NS]
            if near:
                free.remove(min(near, key=lambda f: abs(f - contact)))
                hits += 1
        unlisted = 0
        for start, end, count in bout.untimed:
            unlisted += min(sum(start < f < end for f in free), count)
        totals += [contacts.size, hits, len(free) - unlisted, unlisted]
    return ContactScore(*totals.tolist())


def score_walk(events: Sequence[StepEvent], record: WaypointRecord) -> WalkScore:
    """Distance between the first and the last way-point, and errors at all of them."""
    ends = np.array([e.end_ns for e in events])
    lengths = np.array([e.length_m for e in events])
    headings = np.array([e.heading_rad for e in events])
    path = np.cumsum(lengths * np.exp(1j * headings))
    ours = np.interp(record.waypoint_ns, ends, path.real) + 1j * np.interp(
        record.waypoint_ns, ends, path.imag
    )
    truth = record.waypoint_m @ np.array([1, 1j])
    a, b = ours - ours.mean(), truth - truth.mean()
    turn = np.angle(np.sum(b * np.conj(a)))
    error = np.abs(a * np.exp(1j * turn) - b)
    way = np.interp(record.waypoint_ns[[0, -1]], ends, np.cumsum(lengths))
    return WalkScore(
        steps=len(events),
        distance_m=float(way[1] - way[0]),
        true_distance_m=float(np.abs(np.diff(truth)).sum()),
        rmse_m=float(np.sqrt(np.mean(error**2))),
        max_m=float(error.max()),
        turn_rad=float(turn),
    )


def heading_and_tilt_error(attitude: Array, reference: Array) -> tuple[Array, Array]:
    """Errors (n,) rad about the vertical and of the vertical; quaternions (n, 4) w x y z.

    The error rotation in the map is split into a turn about z and a tilt (swing and twist).
    """
    ours, truth = (Rotation.from_quat(q[:, [1, 2, 3, 0]]) for q in (attitude, reference))
    x, y, z, w = (ours * truth.inv()).as_quat().T
    tilt = 2 * np.arcsin(np.minimum(np.hypot(x, y), 1.0))
    return 2 * np.arctan2(z * np.sign(w), np.abs(w)), tilt
