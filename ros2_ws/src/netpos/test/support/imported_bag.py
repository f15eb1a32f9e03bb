"""What an importer has written, for its tests."""

from __future__ import annotations

from pathlib import Path

from netpos.bags import BagReader, codec
from netpos.messages.values import Odometry, RsuInfo, RsuMeasurement


def values(bag: Path) -> tuple[list[RsuInfo], list[RsuMeasurement], list[Odometry]]:
    """RSUs, measurements and truth of a bag whose messages stand in order of their stamps."""
    make = codec()
    with BagReader(bag) as reader:
        infos = [make.rsu_info_from_msg(e.message) for e in reader.messages(["/rsu/info"])]
        measured = [
            make.measurement_from_msg(e.message) for e in reader.messages(["/rsu/measurements"])
        ]
        truth = [
            make.odometry_from_msg(e.message)
            for e in reader.messages({"/vue_1/ground_truth"} & reader.topics.keys())
        ]
        stamps = [e.log_time_ns for e in reader.messages()]
        assert stamps == sorted(stamps)
        first = next(iter(reader.messages()))
        assert first.topic == "/rsu/info"
        for entry in reader.messages():
            stamp = entry.message.header.stamp
            assert entry.log_time_ns == stamp.sec * 10**9 + stamp.nanosec
    return infos, measured, truth
