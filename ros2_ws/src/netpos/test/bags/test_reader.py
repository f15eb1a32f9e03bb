"""Reading in order, and refusing what is not whole."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from netpos.bags import BagError, BagReader, BagWriter, codec
from netpos.messages.topics import RUN_ESTIMATOR
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore


def clock_bag(path: Path, times: list[int], *, flush_each: bool = False) -> Path:
    with BagWriter(path) as bag:
        for ns in times:
            bag.write("/clock", codec().clock_to_msg(ns), ns)
            if flush_each:
                bag.flush()
    return path


@pytest.mark.parametrize("flush_each", [False, True])
def test_log_time_order_with_ties_as_recorded(tmp_path: Path, flush_each: bool) -> None:
    with BagWriter(tmp_path / "run") as bag:
        for index, ns in enumerate([5, 3, 5, 1, 3, 5]):
            bag.write("/clock", codec().clock_to_msg(index), ns)
            if flush_each:
                bag.flush()
    with BagReader(tmp_path / "run") as reader:
        read = [(e.log_time_ns, e.message.clock.nanosec) for e in reader.messages()]
        assert (reader.start_ns, reader.end_ns) == (1, 5)
    assert read == [(1, 3), (3, 1), (3, 4), (5, 0), (5, 2), (5, 5)]


def test_topics_filter_and_unknown_topic(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        for topic in ("/a", "/b"):
            bag.write(topic, codec().clock_to_msg(1), 1)
    with BagReader(tmp_path / "run") as reader:
        assert [e.topic for e in reader.messages(["/b"])] == ["/b"]
        with pytest.raises(BagError, match="no topic /c; it holds /a, /b"):
            list(reader.messages(["/c"]))


def test_single_file_is_a_bag_too(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run", metadata={"seed": "3"}) as bag:
        bag.write("/clock", codec().clock_to_msg(9), 9)
    with BagReader(tmp_path / "run" / "run_0.mcap") as reader:
        assert [e.log_time_ns for e in reader.messages()] == [9]
        assert reader.metadata == {"seed": "3"}


def test_bag_of_another_writer(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    clock, time = (
        store.types["rosgraph_msgs/msg/Clock"],
        store.types["builtin_interfaces/msg/Time"],
    )
    with Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/clock", clock.__msgtype__, typestore=store)
        raw = store.serialize_cdr(clock(clock=time(sec=1, nanosec=2)), clock.__msgtype__)
        writer.write(connection, 17, raw)
    with BagReader(tmp_path / "run") as reader:
        (entry,) = reader.messages()
    assert (entry.log_time_ns, entry.message.clock.nanosec) == (17, 2)


def test_missing_empty_and_foreign_paths(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="does not exist"):
        BagReader(tmp_path / "nowhere")
    with pytest.raises(BagError, match="is not a bag"):
        BagReader(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(BagError, match="is not a bag"):
        BagReader(tmp_path / "notes.txt")
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(BagError, match="netpos recover"):
        BagReader(tmp_path / "empty.mcap")


def test_unfinished_bag_names_the_remedy(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "run")
    bag.write("/clock", codec().clock_to_msg(1), 1)
    bag.flush()
    with pytest.raises(BagError, match=r"did not finish.*netpos recover"):
        BagReader(tmp_path / "run")
    bag.close()


def test_wrong_counts_are_an_error_not_fewer_messages(tmp_path: Path) -> None:
    folder = clock_bag(tmp_path / "run", [1, 2, 3])
    file = folder / "metadata.yaml"
    content = yaml.safe_load(file.read_text())
    information = content["rosbag2_bagfile_information"]
    information["message_count"] = 4
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(BagError, match="4 messages announced"):
        BagReader(folder)
    information["topics_with_message_count"][0]["message_count"] = 4
    file.write_text(yaml.safe_dump(content))
    with BagReader(folder) as reader, pytest.raises(BagError, match="3 of 4 messages found"):
        list(reader.messages())


def test_one_wrong_bit_in_the_index_is_found(tmp_path: Path) -> None:
    """The topic's name in the summary: rosbags alone would read it happily."""
    folder = clock_bag(tmp_path / "run", [1, 2, 3])
    file = folder / "run_0.mcap"
    data = bytearray(file.read_bytes())
    data[data.rindex(b"/clock") + 1] ^= 1
    file.write_bytes(data)
    with pytest.raises(BagError, match="no sound index"):
        BagReader(file)


def test_payload_that_does_not_fit_its_type(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        bag.write_raw("/clock", "rosgraph_msgs/msg/Clock", b"\0\1\0\0\1\0", 1)
    with BagReader(tmp_path / "run") as reader:
        (entry,) = reader.messages()
        with pytest.raises(BagError, match="/clock"):
            _ = entry.message


def say(bag: BagWriter, key: str, value: str) -> None:
    """A node says how it runs."""
    store, name = get_typestore(Stores.ROS2_JAZZY), "diagnostic_msgs/msg/KeyValue"
    message = store.types[name](key=key, value=value)
    bag.write_raw(RUN_ESTIMATOR, name, bytes(store.serialize_cdr(message, name)), 1)


def test_facts_are_those_of_the_metadata_and_of_the_topics_of_nodes(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run", metadata={"seed": "3", "tracker": "a: 1"}) as bag:
        say(bag, "fusion", "b: 2")
        say(bag, "tracker", "a: 1")
        say(bag, "tracker", "a: 2")
        say(bag, "tracker", "a: 2")
    with BagReader(tmp_path / "run") as reader:
        assert reader.facts == {
            "seed": ("3",),
            "fusion": ("b: 2",),
            "tracker": ("a: 1", "a: 2"),
        }


def test_what_is_noted_at_the_end_is_metadata(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run", metadata={"seed": "3"}) as bag:
        bag.write("/clock", codec().clock_to_msg(9), 9)
        bag.note("lost", "/a: 4")
    for path in (tmp_path / "run", tmp_path / "run" / "run_0.mcap"):
        with BagReader(path) as reader:
            assert reader.metadata == {"seed": "3", "lost": "/a: 4"}
