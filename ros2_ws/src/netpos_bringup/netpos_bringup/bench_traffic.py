"""What the probe sends: two RSUs that measure devices going in circles, as serialised messages."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

import numpy as np
from netpos.messages.values import Field, InitialPose, RsuInfo, RsuMeasurement
from netpos_node import CODEC
from rclpy.serialization import serialize_message

PERIOD_S = 0.1
START_NS = 1_000_000_000
RSUS = (
    RsuInfo(rsu_id="west", position=np.array([0.0, 0.0, 10.0])),
    RsuInfo(rsu_id="east", position=np.array([120.0, 40.0, 10.0])),
)
"""The honest ones."""
FLOODER = "flooder"
_SPEED_MPS = 5.0
_AZIMUTH_SD = math.radians(2.0)
_RANGE_SD_M = 1.0
_SPEED_OF_LIGHT_MPS = 299_792_458.0


def flooding(time_s: float) -> bytes:
    """What the flooder sends of the first device at a time; it never told where it is."""
    measurement = RsuMeasurement(
        stamp_ns=START_NS + round(time_s * 1e9),
        rsu_id=FLOODER,
        vue_id="vue_1",
        fields=Field.RANGE,
        range_m=10.0,
        range_var=1.0,
    )
    return bytes(serialize_message(CODEC.measurement_to_msg(measurement)))


@dataclass(frozen=True, slots=True)
class Device:
    """One device on a circle round ``x_m``, ``y_m``; ``seed`` draws the noise."""

    vue_id: str
    seed: int
    x_m: float
    y_m: float
    radius_m: float
    phase_rad: float

    @classmethod
    def draw(cls, vue_id: str, seed: int) -> Device:
        """A device somewhere between the RSUs."""
        draw = random.Random(seed)
        x_m, y_m, radius_m = draw.uniform(30, 90), draw.uniform(-30, 70), draw.uniform(8, 25)
        return cls(vue_id, seed, x_m, y_m, radius_m, draw.uniform(0.0, 2.0 * math.pi))

    def position(self, time_s: float) -> tuple[float, float]:
        """East and north [m] at a time."""
        angle = self.phase_rad + _SPEED_MPS / self.radius_m * time_s
        return (
            self.x_m + self.radius_m * math.cos(angle),
            self.y_m + self.radius_m * math.sin(angle),
        )

    def stamp_ns(self, epoch: int) -> int:
        """Stamp of an epoch."""
        return START_NS + round(epoch * PERIOD_S * 1e9)

    def pose(self, epoch: int) -> bytes:
        """Serialised initial pose at an epoch."""
        x, y = self.position(epoch * PERIOD_S)
        pose = InitialPose(
            stamp_ns=self.stamp_ns(epoch),
            vue_id=self.vue_id,
            position=np.array([x, y, 0.0]),
            cov=np.eye(3),
        )
        return bytes(serialize_message(CODEC.initial_pose_to_msg(pose)))

    def measurements(self, epoch: int, offset_ns: tuple[int, int] = (0, 0)) -> tuple[bytes, bytes]:
        """Serialised DOA and TOA of both RSUs at an epoch; ``offset_ns`` shifts their stamps."""
        x, y = self.position(epoch * PERIOD_S)
        noise = random.Random(1_000_003 * self.seed + epoch)
        messages = []
        for rsu, offset in zip(RSUS, offset_ns, strict=True):
            dx, dy, dz = x - rsu.position[0], y - rsu.position[1], -rsu.position[2]
            distance_m = math.sqrt(dx * dx + dy * dy + dz * dz) + noise.gauss(0.0, _RANGE_SD_M)
            measurement = RsuMeasurement(
                stamp_ns=self.stamp_ns(epoch) + offset,
                rsu_id=rsu.rsu_id,
                vue_id=self.vue_id,
                sequence=epoch,
                expected=len(RSUS),
                fields=Field.AZIMUTH | Field.TOA,
                azimuth_rad=math.atan2(dy, dx) + noise.gauss(0.0, _AZIMUTH_SD),
                azimuth_var=_AZIMUTH_SD**2,
                toa_s=distance_m / _SPEED_OF_LIGHT_MPS,
                toa_var=(_RANGE_SD_M / _SPEED_OF_LIGHT_MPS) ** 2,
            )
            messages.append(bytes(serialize_message(CODEC.measurement_to_msg(measurement))))
        return messages[0], messages[1]
