"""The folder layout of rosbag2 (Jazzy): NAME/metadata.yaml beside NAME/NAME_0.mcap."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Metadata, Schema
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

from netpos.common.files import write_text
from netpos.common.yaml_text import dump_yaml

VERSION = 9
ROS_DISTRO = "jazzy"
METADATA_FILE = "metadata.yaml"
LIBRARY = "netpos"  # first word of the library in the MCAP header
RUN_RECORD = "netpos"  # MCAP metadata record of the run; custom_data in metadata.yaml
LOST_METADATA = "lost"  # messages that a recorder missed, by topic, as YAML
DEFINITION_ATTACHMENT = "netpos/definition"  # schema and channel record of one topic
RUN_ATTACHMENT = "netpos/run"  # the same as RUN_RECORD, under the checksum of an attachment
ROSBAG2_RECORD = "rosbag2"  # MCAP metadata record in which rosbag2 repeats metadata.yaml


@dataclass(slots=True, kw_only=True)
class Topic:
    """One recorded topic."""

    name: str
    type_name: str
    profiles: list[Qos]
    definition: str
    type_hash: str
    count: int = 0
    channel_id: int = field(default=0)


def channel_metadata(topic: Topic) -> dict[str, str]:
    """Metadata of an MCAP channel as rosbag2 writes it."""
    return {
        "offered_qos_profiles": qos_yaml(topic.profiles),
        "topic_type_hash": topic.type_hash,
    }


def definition_records(topic: Topic, schema_id: int) -> bytes:
    """Schema and channel record of a topic, zstd-compressed."""
    records = RecordBuilder()
    text = topic.definition.encode()
    Schema(id=schema_id, data=text, encoding="ros2msg", name=topic.type_name).write(records)
    Channel(
        id=topic.channel_id,
        topic=topic.name,
        message_encoding="cdr",
        metadata=channel_metadata(topic),
        schema_id=schema_id,
    ).write(records)
    return bytes(zstandard.compress(records.end()))


def run_records(run: Mapping[str, str]) -> bytes:
    """Metadata record of the run, zstd-compressed."""
    records = RecordBuilder()
    Metadata(name=RUN_RECORD, metadata=dict(run)).write(records)
    return bytes(zstandard.compress(records.end()))


def storage_file(folder: Path) -> Path:
    """The MCAP file of a bag folder."""
    return folder / f"{folder.name}_0.mcap"


def qos_yaml(profiles: list[Qos]) -> str:
    """Profiles as the text of an MCAP channel's ``offered_qos_profiles``."""
    if not profiles:
        return ""
    return dump_yaml(dump_qos_v9(profiles), sort_keys=False).strip()


def describe(
    file_name: str,
    topics: Iterable[Topic],
    start_ns: int,
    end_ns: int,
    run: Mapping[str, str],
) -> dict[str, Any]:
    """Content of metadata.yaml below ``rosbag2_bagfile_information``."""
    topics = list(topics)

    def span() -> dict[str, Any]:  # anew each time: shared parts would become YAML anchors
        return {
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "duration": {"nanoseconds": end_ns - start_ns},
            "message_count": sum(topic.count for topic in topics),
        }

    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "relative_file_paths": [file_name],
        **span(),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type_name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": dump_qos_v9(topic.profiles),
                    "type_description_hash": topic.type_hash,
                },
                "message_count": topic.count,
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": file_name, **span()}],
        "custom_data": dict(run) or None,
        "ros_distro": ROS_DISTRO,
    }


def dump(information: Mapping[str, Any]) -> str:
    """YAML text of a mapping, keys in the given order."""
    return dump_yaml(dict(information), sort_keys=False, allow_unicode=True)


def write_metadata(folder: Path, information: Mapping[str, Any]) -> None:
    """Write metadata.yaml in one step: it exists only when it is whole."""
    write_text(folder / METADATA_FILE, dump({"rosbag2_bagfile_information": information}))
