"""Fast opening of a bag folder with one indexed MCAP file, the ordinary case.

rosbags reads metadata.yaml, and the profiles of each topic, with a YAML parser written in Python,
which takes as long as reading ten seconds of measurements. Any other folder is left to
rosbags, which also says what is wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from netpos.bags import layout
from netpos.common.yaml_text import load_yaml


class SingleFile:
    """The file of a bag folder, opened. It may be read like one of rosbags' (``bio``, ``chunks``).

    ``topics``: type, number of messages, profiles and definition by name, in the order of
    metadata.yaml; ``channels``: names by channel; ``start_ns`` and ``end_ns`` of the messages;
    ``custom``: what metadata.yaml holds of the run.

    Raises nearly any exception for other folders.
    """

    def __init__(self, folder: Path) -> None:
        text = (folder / layout.METADATA_FILE).read_text(encoding="utf-8")
        description = load_yaml(text)["rosbag2_bagfile_information"]
        (name,) = description["relative_file_paths"]
        plain = description["storage_identifier"] == "mcap" and not description["compression_mode"]
        _require(plain and description["version"] <= layout.VERSION)
        self.custom: dict[str, Any] = description["custom_data"] or {}
        self.file = folder / Path(name).name
        self.bio = self.file.open("rb")
        try:
            self._index()
            self._order(description)
        except BaseException:
            self.bio.close()
            raise

    def _index(self) -> None:
        reader = make_reader(self.bio)
        summary = reader.get_summary()
        _require(reader.get_header().profile == "ros2" and summary is not None)
        assert summary is not None
        statistics, self.chunks = summary.statistics, summary.chunk_indexes
        _require(statistics is not None and bool(self.chunks))
        assert statistics is not None
        self.message_count = statistics.message_count
        self.start_ns, self.end_ns = statistics.message_start_time, statistics.message_end_time
        self.channels: dict[int, str] = {}
        self.topics: dict[str, tuple[str, int, list[Qos], str]] = {}
        for number, channel in summary.channels.items():
            schema = summary.schemas[channel.schema_id]
            usual = (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
            _require(usual and channel.topic not in self.topics)
            self.channels[number] = channel.topic
            self.topics[channel.topic] = (
                schema.name,
                statistics.channel_message_counts.get(number, 0),
                parse_qos(load_yaml(channel.metadata.get("offered_qos_profiles", "")) or []),
                schema.data.decode(),
            )

    def _order(self, description: dict[str, Any]) -> None:
        """Put the topics in the order of metadata.yaml, which has to promise what is there."""
        promised = {}
        for entry in description["topics_with_message_count"]:
            topic = entry["topic_metadata"]
            profiles = parse_qos(topic["offered_qos_profiles"])
            promised[topic["name"]] = (topic["type"], entry["message_count"], profiles)
        _require(promised == {name: info[:3] for name, info in self.topics.items()})
        start_ns = description["starting_time"]["nanoseconds_since_epoch"]
        span = start_ns, start_ns + description["duration"]["nanoseconds"]
        _require(span == (self.start_ns, self.end_ns))
        _require(description["message_count"] == self.message_count)
        self.topics = {name: self.topics[name] for name in promised}

    def close(self) -> None:
        """Close the file."""
        self.bio.close()


def _require(usual: bool) -> None:
    if not usual:
        raise ValueError("not as usual")


def open_single_file(folder: Path) -> SingleFile | None:
    """The only file of a folder; None where rosbags has to open it."""
    try:
        return SingleFile(folder)
    except Exception:  # damaged bytes raise nearly anything
        return None
