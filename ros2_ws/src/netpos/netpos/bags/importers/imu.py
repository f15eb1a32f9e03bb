"""Recordings of a worn or carried IMU: /VUE/imu and, where there is a magnetometer, /VUE/mag.

Formats are those of ``netpos.inertial.loaders``. Stamps keep their spacing; a recording that
counts from 0 starts at 1 s, for a stamp of 0 is no stamp. A recording without a gyro carries rates
of 0 with the covariance -1 (not measured, REP-145).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import netpos
from netpos.bags.types import codec
from netpos.bags.writer import whole_bag
from netpos.inertial import loaders
from netpos.messages import topics
from netpos.messages.values import ImuSample, MagneticSample

FIRST_STAMP_NS = 1_000_000_000

FORMATS: dict[str, Callable[[Path], loaders.ImuRecord]] = {
    "waist-imu": lambda path: loaders.load_waist_imu(path).imu,
    "steps-phone": lambda path: loaders.load_steps_phone(path).imu,
    "pdr-phone": lambda path: loaders.load_pdr_phone(path).imu,
}


def import_imu(
    path: Path, bag: Path, *, recording_format: str, vue_id: str = "vue_1"
) -> dict[str, int]:
    """Write one recording as a bag; returns messages per topic.

    Raises
    ------
    ValueError  missing or malformed file
    FileExistsError  ``bag`` exists
    """
    record = FORMATS[recording_format](Path(path))
    offset_ns = FIRST_STAMP_NS if record.stamp_ns[0] <= 0 else 0
    imu_topic, mag_topic = (topics.of_vue(vue_id, n) for n in (topics.IMU, topics.MAG))
    metadata = {
        "source": f"{recording_format} {Path(path).name}",
        "netpos_version": netpos.__version__,
    }
    make = codec()
    rates = record.angular_velocity
    with whole_bag(bag, metadata=metadata) as writer:
        for i, stamp in enumerate(record.stamp_ns):
            stamp_ns = int(stamp) + offset_ns
            if record.magnetic_field is not None:
                sample = MagneticSample(
                    stamp_ns=stamp_ns, vue_id=vue_id, magnetic_field=record.magnetic_field[i]
                )
                writer.write(mag_topic, make.magnetic_field_to_msg(sample), stamp_ns)
            imu = ImuSample(
                stamp_ns=stamp_ns,
                vue_id=vue_id,
                angular_velocity=0.0 * record.specific_force[i] if rates is None else rates[i],
                specific_force=record.specific_force[i],
                angular_velocity_var=-1.0 if rates is None else 0.0,
            )
            writer.write(imu_topic, make.imu_to_msg(imu), stamp_ns)
        return writer.counts
