"""What the probe sends and reads, and the relay's answer; never how fast anything is."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from netpos.estimation.motion import SPEED_OF_LIGHT_MPS
from netpos.messages.values import Field, RsuMeasurement
from netpos_bringup.bench_common import stamp_of
from netpos_bringup.bench_process import Measured
from netpos_bringup.bench_relay import MEASUREMENTS, ODOMETRY, RelayNode
from netpos_bringup.bench_traffic import RSUS, START_NS, Device
from netpos_msgs.msg import RsuMeasurement as RsuMeasurementMsg
from netpos_node import CODEC
from rclpy.context import Context
from rclpy.serialization import deserialize_message, serialize_message

DOMAIN = 62


@pytest.fixture
def context() -> Iterator[Context]:
    """A context of its own."""
    own = Context()
    rclpy.init(context=own, domain_id=DOMAIN)
    yield own
    rclpy.shutdown(context=own)


def measurements(device: Device, epoch: int) -> list[RsuMeasurement]:
    return [
        CODEC.measurement_from_msg(deserialize_message(cdr, RsuMeasurementMsg))
        for cdr in device.measurements(epoch)
    ]


def test_measurements_are_of_the_device_where_it_is() -> None:
    """Averaged over the noise, angles and times point to the circle."""
    device = Device.draw("vue_7", 7)
    errors = []
    for epoch in range(200):
        x, y = device.position(0.1 * epoch)
        for rsu, m in zip(RSUS, measurements(device, epoch), strict=True):
            d = np.array([x, y, 0.0]) - rsu.position
            azimuth = math.remainder(m.azimuth_rad - math.atan2(d[1], d[0]), math.tau)
            distance = m.toa_s * SPEED_OF_LIGHT_MPS - np.linalg.norm(d)
            toa_var_m2 = m.toa_var * SPEED_OF_LIGHT_MPS**2
            errors.append((azimuth**2 / m.azimuth_var, distance**2 / toa_var_m2))
            assert (m.rsu_id, m.vue_id, m.expected) == (rsu.rsu_id, "vue_7", 2)
            assert m.fields == Field.AZIMUTH | Field.TOA
            assert m.stamp_ns == START_NS + epoch * 100_000_000
        assert math.hypot(x - device.x_m, y - device.y_m) == pytest.approx(device.radius_m)
    azimuth, distance = np.mean(errors, axis=0)
    assert 0.8 < azimuth < 1.2
    assert 0.8 < distance < 1.2


def test_devices_and_noise_are_drawn_from_their_seed() -> None:
    assert Device.draw("a", 3) == Device.draw("a", 3)
    assert Device.draw("a", 3) != Device.draw("a", 4)
    assert Device.draw("a", 3).measurements(5) == Device.draw("a", 3).measurements(5)


def test_pose_is_where_the_device_is() -> None:
    device = Device.draw("vue_1", 1)
    msg = deserialize_message(device.pose(4), PoseWithCovarianceStamped)
    position = msg.pose.pose.position
    assert (position.x, position.y) == device.position(0.4)
    assert stamp_of(device.pose(4)) == START_NS + 400_000_000


def test_stamp_is_read_from_the_bytes() -> None:
    msg = Odometry()
    msg.header.stamp.sec, msg.header.stamp.nanosec = 12, 345_678_901
    assert stamp_of(serialize_message(msg)) == 12_345_678_901


def test_offsets_shift_the_stamps() -> None:
    first, second = Device.draw("vue_1", 1).measurements(2, (-1, 0))
    assert stamp_of(second) - stamp_of(first) == 1


def test_relay_answers_with_the_stamp(context: Context) -> None:
    node = RelayNode(context=context, start_parameter_services=False)
    answers: list[Odometry] = []
    node._pub.publish = answers.append  # type: ignore[method-assign]
    cdr, _ = Device.draw("vue_1", 1).measurements(3)
    msg = deserialize_message(cdr, RsuMeasurementMsg)
    node._on_measurement(msg)
    assert answers[0].header.stamp == msg.header.stamp
    topics = {name for name, _ in node.get_topic_names_and_types()}
    assert {MEASUREMENTS, ODOMETRY} <= topics
    node.destroy_node()


def wait_until_it_writes(process: Measured, log: Path) -> None:
    end = time.monotonic() + 20.0
    while not (log.is_file() and log.read_text()) and time.monotonic() < end:
        process.check()
        time.sleep(0.01)


def test_a_process_is_measured_and_ended(tmp_path: Path) -> None:
    """A process that computes uses about the processor time it says it has used."""
    program = (
        "import time\nblock = bytearray(50_000_000)\n"
        "while time.process_time() < 0.5: pass\n"
        "print(time.process_time(), flush=True)\ntime.sleep(60)\n"
    )
    log = tmp_path / "log"
    with Measured([sys.executable, "-c", program], log) as process:
        wait_until_it_writes(process, log)
        assert process.cpu_s() == pytest.approx(float(log.read_text()), abs=0.05)
        assert 50.0 < process.memory_mb() < 200.0
    with pytest.raises(RuntimeError, match="ended early"):
        process.check()


def test_a_process_that_fails_is_quoted(tmp_path: Path) -> None:
    log = tmp_path / "log"
    command = [sys.executable, "-c", "import sys; sys.exit('out of paper')"]
    with Measured(command, log) as process, pytest.raises(RuntimeError, match="out of paper"):
        wait_until_it_writes(process, tmp_path / "never")
