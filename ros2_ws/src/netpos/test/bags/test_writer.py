"""Bags against independent readers: mcap, mcap_ros2 and rosbags."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from netpos.bags import BagError, BagReader, BagWriter, codec, typestore
from netpos.bags.qos import profile
from netpos.bags.types import definition, type_hash
from netpos.messages.values import Field, Odometry, RsuInfo, RsuMeasurement
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

RUN = {"scenario": 'name: x\n# "quoted": äöü\n', "seed": "7"}


def samples(n: int) -> list[tuple[str, Any, int]]:
    """n messages of three types, seeded."""
    rng = np.random.default_rng(1)
    messages: list[tuple[str, Any, int]] = []
    for i in range(n):
        ns = 1_700_000_000_000_000_000 + i * 10_000_000
        measurement = RsuMeasurement(
            stamp_ns=ns,
            rsu_id=f"rsu_{i % 3}",
            vue_id="vue_1",
            fields=Field.AZIMUTH,
            azimuth_rad=float(rng.normal()),
            azimuth_var=0.01,
        )
        truth = Odometry(
            stamp_ns=ns,
            vue_id="vue_1",
            position=rng.normal(size=3),
            quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
            linear_velocity=rng.normal(size=3),
        )
        messages.append(("/rsu/measurements", codec().measurement_to_msg(measurement), ns))
        messages.append(("/vue_1/ground_truth", codec().odometry_to_msg(truth), ns))
    info = RsuInfo(rsu_id="rsu_0", position=np.array([1.0, 2.0, 3.0]))
    return [("/rsu/info", codec().rsu_info_to_msg(info), messages[0][2]), *messages]


def cdr(message: Any) -> bytes:
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def write(path: Path, messages: list[tuple[str, Any, int]]) -> None:
    with BagWriter(path, metadata=RUN) as bag:
        for topic, message, ns in messages:
            bag.write(topic, message, ns)


def test_mcap_reads_the_same_bytes(tmp_path: Path) -> None:
    messages = samples(200)
    write(tmp_path / "run", messages)
    with (tmp_path / "run" / "run_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        read = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        assert reader.get_header().profile == "ros2"
        channels = reader.get_summary().channels.values()
        assert {c.message_encoding for c in channels} == {"cdr"}
        assert {m.name for m in reader.iter_metadata()} == {"netpos", "rosbag2"}
    assert read == [(topic, ns, cdr(message)) for topic, message, ns in messages]


def test_mcap_ros2_decodes_by_the_stored_definitions(tmp_path: Path) -> None:
    messages = samples(3)
    write(tmp_path / "run", messages)
    with (tmp_path / "run" / "run_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = [(c.topic, d) for _, c, _, d in reader.iter_decoded_messages()]
    for (topic, theirs), (_, ours, _) in zip(decoded, messages, strict=True):
        assert theirs.header.stamp.nanosec == ours.header.stamp.nanosec
        if topic == "/rsu/measurements":
            assert theirs.azimuth == ours.azimuth
            assert theirs.rsu_id == ours.rsu_id


def test_rosbags_reads_folder_metadata_and_messages(tmp_path: Path) -> None:
    messages = samples(50)
    write(tmp_path / "run", messages)
    with Reader(tmp_path / "run") as reader:
        assert reader.message_count == 101
        assert {t: info.msgcount for t, info in reader.topics.items()} == {
            "/rsu/info": 1,
            "/rsu/measurements": 50,
            "/vue_1/ground_truth": 50,
        }
        assert reader.start_time == messages[0][2]
        assert reader.end_time == messages[-1][2] + 1
        assert reader.ros_distro == "jazzy"
        assert [bytes(raw) for _, _, raw in reader.messages()] == [cdr(m) for _, m, _ in messages]
    with AnyReader([tmp_path / "run"]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)


def test_metadata_file_has_the_fields_of_version_9(tmp_path: Path) -> None:
    write(tmp_path / "run", samples(5))
    text = (tmp_path / "run" / "metadata.yaml").read_text(encoding="utf-8")
    information = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["relative_file_paths"] == ["run_0.mcap"]
    assert information["files"][0]["message_count"] == information["message_count"] == 11
    assert information["duration"]["nanoseconds"] == 40_000_000
    assert information["custom_data"] == RUN
    topic = information["topics_with_message_count"][0]["topic_metadata"]
    assert topic["offered_qos_profiles"][0]["durability"] == "transient_local"
    assert topic["offered_qos_profiles"][0]["deadline"] == {"sec": 9223372036, "nsec": 854775807}
    assert "&id" not in text  # YAML anchors


def test_qos_is_kept(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        bag.add_topic("/a", "nav_msgs/msg/Odometry", profile(reliable=False, depth=3))
        bag.add_topic("/rsu/info", "netpos_msgs/msg/RsuInfo")
    with BagReader(tmp_path / "run") as reader:
        assert reader.topics["/a"].qos[0].reliability == QosReliability.BEST_EFFORT
        assert reader.topics["/a"].qos[0].depth == 3
        assert reader.topics["/rsu/info"].qos[0].durability == QosDurability.TRANSIENT_LOCAL
        assert list(reader.messages()) == []
        assert (reader.start_ns, reader.end_ns) == (0, 0)


def test_same_calls_give_the_same_file(tmp_path: Path) -> None:
    digests = set()
    for parent in ("a", "b"):
        write(tmp_path / parent / "run", samples(400))
        files = sorted((tmp_path / parent / "run").iterdir())
        digests.add(tuple(hashlib.sha256(file.read_bytes()).digest() for file in files))
    assert len(digests) == 1


def test_existing_path_is_refused_and_untouched(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine").write_text("x")
    with pytest.raises(FileExistsError, match="never overwritten"):
        BagWriter(tmp_path / "run")
    assert [f.name for f in (tmp_path / "run").iterdir()] == ["mine"]


def test_an_exception_still_finishes_the_bag(tmp_path: Path) -> None:
    topic, message, ns = samples(1)[1]

    def fail() -> None:
        with BagWriter(tmp_path / "run") as bag:
            bag.write(topic, message, ns)
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail()
    with BagReader(tmp_path / "run") as reader:
        assert reader.topics[topic].count == 1


def test_a_topic_keeps_its_type(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        bag.add_topic("/a", "nav_msgs/msg/Odometry")
        with pytest.raises(BagError, match=r"/a is recorded as nav_msgs/msg/Odometry"):
            bag.write_raw("/a", "sensor_msgs/msg/Imu", b"\0\1\0\0", 1)
        with pytest.raises(BagError, match="package/msg/Type"):
            bag.add_topic("/b", "Odometry")
        with pytest.raises(BagError, match="install its package"):
            bag.add_topic("/b", "no_such_msgs/msg/Thing")
        for bad_ns in (-1, 2**63):
            with pytest.raises(BagError, match="log time"):
                bag.write_raw("/a", "nav_msgs/msg/Odometry", b"\0\1\0\0", bad_ns)


def test_flush_puts_every_message_on_disk(tmp_path: Path) -> None:
    messages = samples(20)
    bag = BagWriter(tmp_path / "run")
    for topic, message, ns in messages:
        bag.write(topic, message, ns)
    bag.flush()
    payloads = []
    with (tmp_path / "run" / "run_0.mcap").open("rb") as stream, suppress(EndOfFile):
        for record in StreamReader(stream).records:
            if isinstance(record, Message):
                payloads.append(record.data)  # noqa: PERF401  # the end raises
    assert payloads == [cdr(message) for _, message, _ in messages]
    bag.close()


def test_types_found_at_run_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A type rosbags does not know, made of a standard one and one of its own package."""
    folder = tmp_path / "prefix" / "share" / "trial_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Outer.msg").write_text("std_msgs/Header header\nInner[] parts  # m\n")
    (folder / "Inner.msg").write_text("uint8 FIXED=3\nfloat32[2] xy\nstring name\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "prefix"), prepend=":")
    text = definition("trial_msgs/msg/Outer")
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, "trial_msgs/msg/Outer"))
    types = store.types
    outer = types["trial_msgs/msg/Outer"](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=5, nanosec=6), frame_id="map"
        ),
        parts=[types["trial_msgs/msg/Inner"](xy=np.array([1, 2], np.float32), name="n")],
    )
    raw = bytes(store.serialize_cdr(outer, "trial_msgs/msg/Outer"))
    with BagWriter(tmp_path / "run") as bag:
        bag.write_raw("/t", "trial_msgs/msg/Outer", raw, 1)
    with (tmp_path / "run" / "run_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        (decoded,) = [item.decoded_message for item in reader.iter_decoded_messages()]
    assert list(decoded.parts[0].xy) == [1.0, 2.0]
    assert decoded.header.stamp.sec == 5


@pytest.mark.parametrize(
    "type_name", ["std_msgs/msg/Header", "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu"]
)
def test_type_hash_is_that_of_the_installation(type_name: str) -> None:
    """The ROS installation states its own REP-2016 hashes beside the definitions."""
    package, _, name = type_name.split("/")
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(":")
    files = [Path(p) / "share" / package / "msg" / f"{name}.json" for p in prefixes]
    file = next((f for f in files if f.is_file()), None)
    if file is None:
        pytest.skip("no ROS installation in AMENT_PREFIX_PATH")
    stated = {
        h["type_name"]: h["hash_string"] for h in json.loads(file.read_text())["type_hashes"]
    }
    assert type_hash(type_name, definition(type_name)) == stated[type_name]
