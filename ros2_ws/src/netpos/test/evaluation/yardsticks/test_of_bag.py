"""Measurements of a bag as arrays."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from corner_ranges import S
from netpos.bags.recording import write_values
from netpos.evaluation.yardsticks import (
    Kind,
    observations_of_bag,
    observations_of_devices,
)
from netpos.messages.values import AngleConvention, Field, Odometry, RsuInfo, RsuMeasurement
from scipy.spatial.transform import Rotation


def bag_of(path: Path) -> Path:
    """A cone array that looks west and a ranging RSU hear one beacon; a third device is not
    asked for."""
    array = RsuInfo(
        rsu_id="array",
        position=np.array([5.0, 0.0, 2.0]),
        quaternion=Rotation.from_euler("z", math.pi).as_quat(),
        azimuth_bias_sd_rad=0.03,
        angle_convention=AngleConvention.CONE,
    )
    anchor = RsuInfo(
        rsu_id="anchor", position=np.ones(3), range_bias_sd_m=0.4, common_range_bias_sd_m=1.2
    )

    def heard(rsu: str, fields: Field, vue: str = "vue_1", stamp_ns: int = S) -> RsuMeasurement:
        return RsuMeasurement(
            stamp_ns=stamp_ns,
            rsu_id=rsu,
            vue_id=vue,
            fields=fields,
            azimuth_rad=math.pi / 3,
            azimuth_var=0.08**2,
            elevation_rad=0.1,
            elevation_var=0.2**2,
            range_m=7.0,
            range_var=0.3**2,
            lever_arm=(0.1, 0.2, 0.3),
        )

    measured = [
        heard("anchor", Field.RANGE),
        heard("array", Field.AZIMUTH | Field.ELEVATION),
        heard("anchor", Field.RANGE, "vue_2", 2 * S),
    ]
    truth = [
        Odometry(
            stamp_ns=k * S,
            vue_id="vue_1",
            position=np.zeros(3),
            quaternion=np.array([0.0, 0, 0, 1]),
            linear_velocity=np.zeros(3),
        )
        for k in (1, 2)
    ]
    write_values(path, rsus=[array, anchor], measurements=measured, truth=truth)
    return path


def test_measurements_of_a_bag(tmp_path: Path) -> None:
    bag = bag_of(tmp_path / "bag")
    seen = observations_of_bag(bag)
    assert [Kind(k) for k in seen.kind] == [Kind.RANGE, Kind.AZIMUTH_CONE, Kind.ELEVATION]
    np.testing.assert_allclose(seen.value, [7.0, math.pi / 3, 0.1])
    # noise and biases together; the bias of a cone angle is one of its sine, and cos 60 deg = 1/2
    np.testing.assert_allclose(seen.sd, [1.3, 0.1, 0.2])
    np.testing.assert_allclose(seen.axes[1] @ [-1, 0, 0], [1, 0, 0], atol=1e-12)
    assert not seen.lever_arm.any()  # one antenna: its place is asked for
    assert observations_of_bag(bag, range_sd_m=0.2).sd[0] == 0.2
    assert len(observations_of_bag(bag, kinds=[Kind.ELEVATION])) == 1
    with pytest.raises(
        ValueError, match="no azimuth, elevation, range or time difference of 'vue_3'"
    ):
        observations_of_bag(bag, "vue_3")


def test_measurements_of_several_devices(tmp_path: Path) -> None:
    seen = observations_of_devices(bag_of(tmp_path / "bag"), ["vue_2", "vue_1"])
    assert list(seen) == ["vue_2", "vue_1"]
    assert seen["vue_2"].stamp_ns.tolist() == [2 * S]
    assert len(seen["vue_1"]) == 3
