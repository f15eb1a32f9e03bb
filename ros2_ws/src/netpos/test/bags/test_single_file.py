"""The short way into a folder of one file tells what rosbags tells, or leaves it to rosbags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from netpos.bags import BagError, BagReader, BagWriter, codec
from netpos.bags.single_file import open_single_file
from rosbags.rosbag2 import Reader


def written(folder: Path) -> Path:
    with BagWriter(folder, metadata={"seed": "3", "run": "a: b"}) as bag:
        for ns in (5, 3, 9):
            bag.write("/b", codec().clock_to_msg(ns), ns)
        bag.write("/a", codec().clock_to_msg(1), 4)
    return folder


def changed(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    file = folder / "metadata.yaml"
    loaded = yaml.safe_load(file.read_text())
    change(loaded["rosbag2_bagfile_information"])
    file.write_text(yaml.safe_dump(loaded))
    return folder


def test_what_rosbags_tells(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    file = open_single_file(folder)
    assert file is not None
    file.close()
    with Reader(folder) as reference:
        expected = {
            c.topic: (c.msgtype, c.msgcount, c.ext.offered_qos_profiles, c.msgdef.data)
            for c in reference.connections
        }
        assert list(file.topics) == [c.topic for c in reference.connections]
        assert file.topics == expected
        assert all(qos for _, _, qos, _ in expected.values())
        assert (file.start_ns, file.end_ns) == (reference.start_time, reference.end_time - 1)
        assert file.custom == reference.storage.metadata.custom
        in_order = [(c.topic, time_ns, bytes(cdr)) for c, time_ns, cdr in reference.messages()]
    with BagReader(folder) as bag:
        assert [(e.topic, e.log_time_ns, e.cdr) for e in bag.messages()] == in_order
        assert bag.metadata == {"seed": "3", "run": "a: b"}


@pytest.mark.parametrize(
    "change",
    [
        lambda description: description.update(version=10),
        lambda description: description.update(storage_identifier="sqlite3"),
        lambda description: description.update(compression_mode="file", compression_format="zstd"),
        lambda description: description.update(message_count=5),
        lambda description: description["duration"].update(nanoseconds=7),
        lambda description: description["starting_time"].update(nanoseconds_since_epoch=2),
        lambda description: description["topics_with_message_count"].pop(),
        lambda description: description["topics_with_message_count"][0].update(message_count=4),
        lambda description: description["topics_with_message_count"][0]["topic_metadata"].update(
            type="a/b"
        ),
        lambda description: description["relative_file_paths"].append("run_1.mcap"),
        lambda description: description["relative_file_paths"].__setitem__(0, "other.mcap"),
        lambda description: description.pop("duration"),
    ],
)
def test_what_is_not_as_usual_is_left_to_rosbags(
    tmp_path: Path, change: Callable[[dict[str, Any]], object]
) -> None:
    assert open_single_file(changed(written(tmp_path / "run"), change)) is None


def test_a_promise_not_kept_is_damage(tmp_path: Path) -> None:
    folder = changed(
        written(tmp_path / "run"), lambda description: description.update(message_count=5)
    )
    with pytest.raises(BagError, match="5 messages announced, its topics count 4"):
        BagReader(folder)


def test_broken_metadata(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    assert open_single_file(folder) is None
    with pytest.raises(BagError, match="metadata"):
        BagReader(folder)
