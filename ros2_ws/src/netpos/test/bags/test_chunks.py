"""Chunks: the bytes of mcap's own writer, the order of rosbags' reader."""

from __future__ import annotations

import tracemalloc
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from netpos.bags import BagError, BagReader, BagWriter, codec
from netpos.bags.chunks import FastWriter
from netpos.bags.types import definition
from rosbags.rosbag2 import Reader

CLOCK = "rosgraph_msgs/msg/Clock"


def written_by(kind: Any, *, chunk_size: int, compression: CompressionType, n: int) -> bytes:
    """A file of n messages on three channels, one of them announced late, in no order of time."""
    rng, stream = np.random.default_rng(n), BytesIO()
    files = (stream, BytesIO()) if kind is FastWriter else (stream,)
    writer = kind(*files, chunk_size=chunk_size, compression=compression)
    writer.start(profile="ros2", library="x")
    schema = writer.register_schema("a/msg/B", "ros2msg", b"float64 x")
    channels = [writer.register_channel(f"/{name}", "cdr", schema) for name in "ab"]
    for i in range(n):
        if i == n // 2:
            channels.append(writer.register_channel("/c", "cdr", schema))
            writer.add_attachment(0, 0, "note", "text/plain", b"half")
        if i == n // 3:
            writer.flush()
        data = rng.bytes(int(rng.integers(1, 60)))
        time, channel = int(rng.integers(0, 50)), int(rng.choice(channels))
        writer.add_message(channel, time, data, time + 1, i)
    writer.finish()
    return stream.getvalue()


@pytest.mark.parametrize("n", [0, 1, 300])
@pytest.mark.parametrize("chunk_size", [1, 500, 100_000])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_the_same_file_as_mcaps_writer(
    n: int, chunk_size: int, compression: CompressionType
) -> None:
    options: Any = {"chunk_size": chunk_size, "compression": compression, "n": n}
    assert written_by(FastWriter, **options) == written_by(Writer, **options)


def test_chunks_that_are_written_take_no_memory(tmp_path: Path) -> None:
    """Six minutes of a recorder: four chunks a second of 20 channels."""
    tracemalloc.start()
    try:
        with BagWriter(tmp_path / "run") as bag:
            for k in range(1500):
                for topic in range(20):
                    bag.write_raw(f"/t{topic}", CLOCK, bytes(12), k)
                bag.flush()
                if k == 150:
                    early = tracemalloc.get_traced_memory()[0]
            late = tracemalloc.get_traced_memory()[0]
            assert sorted(p.name for p in bag.path.iterdir()) == ["run_0.mcap"]
    finally:
        tracemalloc.stop()
    assert late - early < 2 * 1350  # bytes; the index of a chunk has 290
    with BagReader(tmp_path / "run") as reader:
        assert len(list(reader.messages())) == 20 * 1500


@pytest.fixture(params=range(4))
def shuffled(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A bag whose chunks overlap in time, with many ties."""
    rng = np.random.default_rng(request.param)
    with BagWriter(tmp_path / "run") as bag:
        for i in range(300):
            time = int(rng.integers(0, 40)) + i // 10
            bag.write(f"/{rng.choice(list('abc'))}", codec().clock_to_msg(i), time)
            if rng.random() < 0.1:
                bag.flush()
    return tmp_path / "run"


@pytest.mark.parametrize("topics", [None, ["/b"], ["/a", "/c"]])
def test_the_same_order_as_rosbags(shuffled: Path, topics: list[str] | None) -> None:
    with Reader(shuffled) as reader:
        wanted = [c for c in reader.connections if topics is None or c.topic in topics]
        theirs = [(c.topic, time, bytes(raw)) for c, time, raw in reader.messages(wanted)]
    for path in (shuffled, shuffled / "run_0.mcap"):
        with BagReader(path) as bag:
            ours = [(e.topic, e.log_time_ns, e.cdr) for e in bag.messages(topics)]
            assert {e.type_name for e in bag.messages(topics)} == {CLOCK}
        assert ours == theirs


def test_two_readings_at_a_time(shuffled: Path) -> None:
    with BagReader(shuffled) as bag:
        alone = [e.cdr for e in bag.messages()]
        pairs = list(zip(bag.messages(), bag.messages(), strict=True))
    assert [a.cdr for a, _ in pairs] == [b.cdr for _, b in pairs] == alone


@pytest.mark.parametrize("change", [-1, 1, 40])
def test_records_that_do_not_fill_their_chunk_are_damage(tmp_path: Path, change: int) -> None:
    """Of an uncompressed chunk without a CRC, in which the last message has a wrong length."""
    file = tmp_path / "run.mcap"
    with file.open("wb") as stream:
        writer = FastWriter(
            stream,
            BytesIO(),
            chunk_size=1000,
            compression=CompressionType.NONE,
            enable_crcs=False,
        )
        writer.start(profile="ros2")
        schema = writer.register_schema(CLOCK, "ros2msg", definition(CLOCK).encode())
        channel = writer.register_channel("/clock", "cdr", schema)
        for time in (1, 2):
            writer.add_message(channel, time, bytes(12), time)
        writer.finish()
    with BagReader(file) as reader:
        assert len(list(reader.messages())) == 2
    data = bytearray(file.read_bytes())
    data[data.rindex(b"\x05" + (22 + 12).to_bytes(8, "little")) + 1] += change
    file.write_bytes(data)
    with BagReader(file) as reader, pytest.raises(BagError, match="netpos recover"):
        list(reader.messages())


def test_wrong_checksum_is_damage(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "run") as bag:
        bag.write("/clock", codec().clock_to_msg(1), 1)
    file = tmp_path / "run" / "run_0.mcap"
    with BagReader(file) as reader:
        (chunk,) = reader._reader.storage.chunks
    data = bytearray(file.read_bytes())
    data[chunk.chunk_start_offset + 9 + 24] ^= 1  # of the chunk's CRC
    file.write_bytes(data)
    with BagReader(file) as reader, pytest.raises(BagError, match="netpos recover"):
        list(reader.messages())


@pytest.mark.parametrize("damage", ["opcode", "channel", "offset", "beyond", "twice"])
def test_an_index_that_does_not_fit_is_damage(tmp_path: Path, damage: str) -> None:
    """The messages have their checksum, where they are is told by an index that has none."""
    with BagWriter(tmp_path / "run") as bag:
        for i in range(3):
            bag.write("/clock", codec().clock_to_msg(i), i)
    file = tmp_path / "run" / "run_0.mcap"
    with BagReader(file) as reader:
        (chunk,) = reader._reader.storage.chunks
        assert len(list(reader.messages())) == 3
    ((_, index_start),) = chunk.message_index_offsets.items()
    damaged_byte = {"opcode": index_start, "channel": index_start + 9}.get(
        damage, index_start + 15 + 8
    )
    data = bytearray(file.read_bytes())
    data[damaged_byte] ^= 1
    if damage == "beyond":
        data[damaged_byte + 6] = 1
    if damage == "twice":
        data[damaged_byte : damaged_byte + 8] = data[damaged_byte + 16 : damaged_byte + 24]
    file.write_bytes(data)
    with BagReader(file) as reader, pytest.raises(BagError, match="netpos recover"):
        list(reader.messages())
