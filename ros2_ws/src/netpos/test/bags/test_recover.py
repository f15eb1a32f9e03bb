"""What is left after a kill or a bad disk: saved, proven, never invented."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from netpos.bags import BagError, BagReader, BagWriter, codec
from netpos.bags.qos import is_latched
from netpos.bags.recover import checksums, recover
from netpos.bags.scan import unpack
from netpos.bags.types import definition

CLOCK = "rosgraph_msgs/msg/Clock"
N = 240


def write(folder: Path, n: int = N) -> Path:
    """n clocks on two topics, six chunks."""
    with BagWriter(folder, metadata={"seed": "3"}) as bag:
        for i in range(n):
            bag.write("/rsu/info" if i % 2 else "/clock", codec().clock_to_msg(i * i), i)
            if i % (n // 6) == n // 6 - 1:
                bag.flush()
    return folder / f"{folder.name}_0.mcap"


def content(path: Path) -> Counter[tuple[str, int, bytes]]:
    with BagReader(path) as reader:
        return Counter((e.topic, e.log_time_ns, e.cdr) for e in reader.messages())


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Counter]:
    file = write(tmp_path_factory.mktemp("bag") / "run")
    return file.read_bytes(), content(file)


def damaged(tmp_path: Path, data: bytes) -> Path:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run_0.mcap").write_bytes(data)
    return tmp_path / "run"


def chunk_offsets(data: bytes, tmp_path: Path) -> list[tuple[int, int]]:
    """(start, length) of each chunk, from the index."""
    file = tmp_path / "index.mcap"
    file.write_bytes(data)
    with file.open("rb") as stream:
        indexes = make_reader(stream).get_summary().chunk_indexes
    return [(c.chunk_start_offset, c.chunk_length) for c in indexes]


def test_cut_in_the_data_keeps_every_whole_chunk(
    tmp_path: Path, original: tuple[bytes, Counter]
) -> None:
    data, messages = original
    start, length = chunk_offsets(data, tmp_path)[3]
    report = recover(damaged(tmp_path, data[: start + length // 2]))
    assert report.output == tmp_path / "run_recovered"
    assert report.messages == N // 6 * 3
    assert report.counts == {"/clock": N // 4, "/rsu/info": N // 4}
    assert (report.start_ns, report.end_ns) == (0, N // 2 - 1)
    assert (report.damaged_places, report.bytes_dropped) == (1, length // 2)
    assert report.unverified == report.unknown == 0
    saved = content(report.output)
    assert saved == Counter({key: 1 for key in messages if key[1] < N // 2})
    with BagReader(report.output) as reader:
        assert reader.metadata == {"recovered_from": "run", "seed": "3"}
        assert is_latched(reader.topics["/rsu/info"].qos)
        assert not is_latched(reader.topics["/clock"].qos)
    assert "read back and equal" in str(report)


def test_damaged_chunk_in_the_middle_is_jumped(
    tmp_path: Path, original: tuple[bytes, Counter]
) -> None:
    data, messages = original
    start, length = chunk_offsets(data, tmp_path)[2]
    bad = bytearray(data)
    bad[start + length // 2] ^= 0xFF
    report = recover(damaged(tmp_path, bytes(bad)))
    gone = range(N // 6 * 2, N // 6 * 3)
    assert content(report.output) == Counter({k: 1 for k in messages if k[1] not in gone})
    assert report.damaged_places == 1
    assert report.bytes_dropped >= length


def test_first_chunk_and_index_lost(tmp_path: Path, original: tuple[bytes, Counter]) -> None:
    """The first chunk holds the schemas; the attachments repeat them."""
    data, messages = original
    offsets = chunk_offsets(data, tmp_path)
    bad = bytearray(data[: sum(offsets[-1])])
    start, length = offsets[0]
    bad[start : start + length] = bytes(length)
    report = recover(damaged(tmp_path, bytes(bad)))
    assert content(report.output) == Counter({k: 1 for k in messages if k[1] >= N // 6})


def test_garbage_after_the_end(tmp_path: Path, original: tuple[bytes, Counter]) -> None:
    data, messages = original
    report = recover(damaged(tmp_path, data + b"\x06" * 999))
    assert content(report.output) == messages
    assert report.bytes_dropped > 0


def test_a_fine_bag_needs_nothing(tmp_path: Path) -> None:
    write(tmp_path / "run")
    before = {f: f.read_bytes() for f in (tmp_path / "run").iterdir()}
    report = recover(tmp_path / "run")
    assert report.output is None
    assert report.messages == N
    assert "nothing to recover" in str(report)
    assert {f: f.read_bytes() for f in (tmp_path / "run").iterdir()} == before
    assert not (tmp_path / "run_recovered").exists()


def test_lost_metadata_file_is_made_anew(tmp_path: Path) -> None:
    file = write(tmp_path / "run")
    (tmp_path / "run" / "metadata.yaml").unlink()
    expected = content(file)
    report = recover(tmp_path / "run")
    assert content(report.output) == expected
    assert report.bytes_dropped == 0


@pytest.mark.parametrize("data", [b"", b"\x89MCAP0\r\n", b"\0" * 5000, b"not a bag"])
def test_nothing_to_save_is_an_error_and_leaves_nothing(tmp_path: Path, data: bytes) -> None:
    folder = damaged(tmp_path, data)
    with pytest.raises(BagError, match="nothing could be saved"):
        recover(folder)
    assert not (tmp_path / "run_recovered").exists()


def test_missing_paths(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="does not exist"):
        recover(tmp_path / "nowhere")
    with pytest.raises(BagError, match=r"no \.mcap file"):
        recover(tmp_path)


def test_never_overwrites(tmp_path: Path, original: tuple[bytes, Counter]) -> None:
    folder = damaged(tmp_path, original[0][:-50])
    (tmp_path / "run_recovered").mkdir()
    (tmp_path / "run_recovered" / "mine").write_text("x")
    with pytest.raises(FileExistsError, match="not overwritten"):
        recover(folder)
    assert [f.name for f in (tmp_path / "run_recovered").iterdir()] == ["mine"]
    assert (folder / "run_0.mcap").read_bytes() == original[0][:-50]


def write_clocks(folder: Path, entries: list[tuple[int, int]], seed: str = "3") -> Path:
    """A bag of clocks (log time, time said)."""
    with BagWriter(folder, metadata={"seed": seed}) as bag:
        for log_time_ns, said_ns in entries:
            bag.write("/clock", codec().clock_to_msg(said_ns), log_time_ns)
    return folder


def test_checksums_cover_log_times(tmp_path: Path) -> None:
    """The same payloads and the same log times, paired the other way round."""
    straight = checksums(write_clocks(tmp_path / "straight", [(1, 10), (2, 20)]))
    again = checksums(write_clocks(tmp_path / "again", [(1, 10), (2, 20)]))
    crossed = checksums(write_clocks(tmp_path / "crossed", [(1, 20), (2, 10)]))
    assert straight == again
    assert straight["/clock"][0] == crossed["/clock"][0] == 2
    assert straight["/clock"][1] != crossed["/clock"][1]


def test_files_are_joined_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """Of messages with one log time the earlier file's come first; what the last file says of the
    run counts. As text, run_10 comes before run_9."""
    (tmp_path / "run").mkdir()
    for number in (2, 9, 10, 11):
        bag = write_clocks(tmp_path / f"part_{number}", [(5, number)], str(number))
        shutil.move(bag / f"part_{number}_0.mcap", tmp_path / "run" / f"run_{number}.mcap")
    report = recover(tmp_path / "run")
    assert report.messages == 4
    with BagReader(report.output) as reader:
        assert [e.message.clock.nanosec for e in reader.messages()] == [2, 9, 10, 11]
        assert reader.metadata["seed"] == "11"


def test_a_recovery_that_fails_half_way_leaves_nothing(
    tmp_path: Path, original: tuple[bytes, Counter], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full after ten messages; once there is room, recovery works."""
    folder = damaged(tmp_path, original[0][:-50])
    write_raw, room = BagWriter.write_raw, iter(range(10))

    def write_until_full(self: BagWriter, *entry: Any) -> None:
        if next(room, None) is None:
            assert (tmp_path / "run_recovered").is_dir()
            raise OSError("no space left on device")
        write_raw(self, *entry)

    with monkeypatch.context() as patched:
        patched.setattr(BagWriter, "write_raw", write_until_full)
        with pytest.raises(OSError, match="no space left"):
            recover(folder)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["run"]
    assert content(recover(folder).output) == original[1]


def test_a_recovery_that_does_not_read_back_as_written_is_discarded(
    tmp_path: Path, original: tuple[bytes, Counter], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A writer that notes other log times."""
    folder = damaged(tmp_path, original[0][:-50])
    write_raw = BagWriter.write_raw

    def write_late(
        self: BagWriter, topic: str, type_name: str, cdr: bytes, log_ns: int, sent_ns: int
    ) -> None:
        write_raw(self, topic, type_name, cdr, log_ns + 1, sent_ns)

    monkeypatch.setattr(BagWriter, "write_raw", write_late)
    with pytest.raises(BagError, match="did not read back as written"):
        recover(folder)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["run"]


CDR = b"\0\1\0\0" + bytes(8)


def foreign(tmp_path: Path, compression: CompressionType, *, chunked: bool) -> bytes:
    """20 clocks as another library writes them, killed before the end."""
    file = tmp_path / "foreign.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream, compression=compression, use_chunking=chunked)
        writer.start(profile="ros2", library="other")
        schema = writer.register_schema(CLOCK, "ros2msg", definition(CLOCK).encode())
        channel = writer.register_channel("/clock", "cdr", schema)
        for i in range(20):
            writer.add_message(channel, i, CDR, i)
        writer.flush()
    return file.read_bytes()


@pytest.mark.parametrize("chunked", [True, False])
def test_uncompressed_messages_before_a_cut_are_kept_but_marked(
    tmp_path: Path, chunked: bool
) -> None:
    data = foreign(tmp_path, CompressionType.NONE, chunked=chunked)
    report = recover(damaged(tmp_path, data[: data.rindex(CDR) + 6]))
    assert sorted(ns for _, ns, _ in content(report.output)) == list(range(19))
    assert report.unverified == 19
    assert "no checksum" in str(report)


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.ZSTD])
def test_cut_compressed_chunk_of_another_writer(
    tmp_path: Path, compression: CompressionType
) -> None:
    data = foreign(tmp_path, compression, chunked=True)
    folder = damaged(tmp_path, data)
    assert sorted(ns for _, ns, _ in content(recover(folder).output)) == list(range(20))
    shutil.rmtree(tmp_path / "run_recovered")
    (folder / "run_0.mcap").write_bytes(data[:250])
    with pytest.raises(BagError, match="nothing could be saved"):
        recover(folder)


@settings(max_examples=150, deadline=None)
@given(choose=st.data())
def test_any_cut_and_any_damage_invents_nothing(
    original: tuple[bytes, Counter], choose: st.DataObject
) -> None:
    data, messages = original
    bad = bytearray(data[: choose.draw(st.integers(0, len(data)))])
    for _ in range(choose.draw(st.integers(0, 4)) if bad else 0):
        place = choose.draw(st.integers(0, len(bad) - 1))
        bad[place] = choose.draw(st.integers(0, 255))
    root = Path(tempfile.mkdtemp())
    try:
        report = recover(damaged(root, bytes(bad)))
        assert not content(report.output or root / "run" / "run_0.mcap") - messages
        assert report.unverified == 0
    except BagError as error:
        assert "nothing could be saved" in str(error)  # noqa: PT017
    finally:
        shutil.rmtree(root)


def test_every_cut_of_the_last_records(tmp_path: Path, original: tuple[bytes, Counter]) -> None:
    """Cuts in the summary and footer lose no message."""
    data, messages = original
    end = sum(chunk_offsets(data, tmp_path)[-1])
    for cut in [*range(end, len(data) - 1, 97), len(data) - 1]:
        folder = damaged(tmp_path, data[:cut])
        assert content(recover(folder).output) == messages
        shutil.rmtree(folder)
        shutil.rmtree(tmp_path / "run_recovered")


WRITER = """
import sys, time
from pathlib import Path
from types import SimpleNamespace
from netpos.bags import BagWriter, codec
bag = BagWriter(Path(sys.argv[1]))
flushed = time.monotonic()
print("ready", flush=True)
while True:
    now = time.time_ns()
    bag.write("/clock", codec().clock_to_msg(now), now)
    if time.monotonic() - flushed > 0.25:
        bag.flush()
        flushed = time.monotonic()
    time.sleep(0.002)
"""


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_killed_writer_loses_at_most_a_second(tmp_path: Path, seed: int) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path / "run")], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(random.Random(seed).uniform(1.0, 2.0))
    killed_ns = time.time_ns()
    process.kill()
    process.wait()
    process.stdout.close()
    report = recover(tmp_path / "run")
    assert killed_ns - report.end_ns < 1_000_000_000
    assert report.messages > 50
    for _, log_time_ns, cdr in content(report.output):
        stamp = int.from_bytes(cdr[4:8], "little") * 10**9 + int.from_bytes(cdr[8:12], "little")
        assert stamp == log_time_ns


DAMAGES = 60
"""Bags of each kind of damage; ``scripts/fuzz.py`` makes more."""


def facts(path: Path) -> dict[str, Any]:
    """What a bag says, message by message and of itself."""
    with BagReader(path) as reader:
        return {
            "messages": Counter(
                (e.topic, e.type_name, e.log_time_ns, e.cdr) for e in reader.messages()
            ),
            "definitions": {name: info.definition for name, info in reader.topics.items()},
            "metadata": dict(reader.metadata),
        }


def compare(path: Path, original: dict[str, Any]) -> None:
    """Everything that is called saved is as it was."""
    found = facts(path)
    assert not found["messages"] - original["messages"]
    for what in ("definitions", "metadata"):
        said = {k: v for k, v in found[what].items() if k != "recovered_from"}
        assert said.items() <= original[what].items()


@pytest.fixture(scope="module")
def many_chunks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of which fifty flips leave something."""
    rng = random.Random(5)
    folder = tmp_path_factory.mktemp("many") / "run"
    with BagWriter(folder, metadata={"scenario": "name: x\nseed: 3\n", "seed": "3"}) as bag:
        for i in range(600):
            said = rng.randrange(2**31 * 10**9)
            bag.write("/rsu/info" if i % 2 else "/clock", codec().clock_to_msg(said), i)
            if i % 5 == 4:
                bag.flush()
    return folder


@pytest.mark.parametrize("flips", [1, 8, 50])
def test_flipped_bytes_are_never_called_saved(
    many_chunks: Path, flips: int, tmp_path: Path
) -> None:
    original, saved = facts(many_chunks), 0
    (file,) = many_chunks.glob("*.mcap")
    for seed in range(DAMAGES):
        rng = random.Random(1000 * flips + seed)
        folder = tmp_path / str(seed) / "run"
        shutil.copytree(many_chunks, folder)
        bad = bytearray(file.read_bytes())
        for _ in range(flips):
            bad[rng.randrange(len(bad))] ^= 1 << rng.randrange(8)
        (folder / file.name).write_bytes(bad)
        try:
            report = recover(folder)
        except BagError as error:
            assert "nothing could be saved" in str(error)  # noqa: PT017
            continue
        compare(report.output or folder, original)
        saved += report.messages
    assert saved > 0.1 * DAMAGES * original["messages"].total()


def test_flips_in_the_description_of_a_bag_are_noticed(many_chunks: Path, tmp_path: Path) -> None:
    """metadata.yaml has no checksum: what it says counts where the file says the same."""
    original = facts(many_chunks)
    text = (many_chunks / "metadata.yaml").read_bytes()
    for seed in range(2 * DAMAGES):
        rng = random.Random(seed)
        folder = tmp_path / str(seed) / "run"
        shutil.copytree(many_chunks, folder)
        bad = bytearray(text)
        bad[rng.randrange(len(bad))] ^= 1 << rng.randrange(8)
        (folder / "metadata.yaml").write_bytes(bad)
        try:
            compare(folder, original)
        except BagError as error:
            assert "try: netpos recover" in str(error)  # noqa: PT017
        output = recover(folder).output
        compare(output or folder, original)
        if output is not None:
            assert facts(output)["messages"] == original["messages"]


@pytest.mark.parametrize("old", [b"/clock", b"rosgraph_msgs/msg/Clock"])
def test_names_changed_alike_in_all_records_without_a_checksum(
    many_chunks: Path, tmp_path: Path, old: bytes
) -> None:
    """One letter other in metadata.yaml and in every plain record of the file."""
    original = facts(many_chunks)
    folder = tmp_path / "run"
    shutil.copytree(many_chunks, folder)
    new = old[:-1] + bytes([old[-1] ^ 1])
    for file in folder.iterdir():
        file.write_bytes(file.read_bytes().replace(old, new))
    compare(recover(folder).output, original)


def test_facts_changed_alike_in_all_records_are_noticed(many_chunks: Path, tmp_path: Path) -> None:
    """The copy under a checksum no longer fits."""
    folder = tmp_path / "run"
    shutil.copytree(many_chunks, folder)
    for file in folder.iterdir():
        file.write_bytes(file.read_bytes().replace(b"seed: 3", b"seed: 2"))
    with pytest.raises(BagError, match="the facts of the run have a wrong CRC"):
        BagReader(folder)


def test_facts_of_an_older_bag_count_where_two_copies_agree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bags without the copy under a checksum."""
    monkeypatch.setattr("netpos.bags.layout.RUN_ATTACHMENT", "something/else")
    with BagWriter(tmp_path / "run", metadata={"seed": "3", "name": "x"}) as bag:
        bag.write("/clock", codec().clock_to_msg(5), 5)
    whole = tmp_path / "run" / "metadata.yaml"
    whole.write_text(whole.read_text().replace("seed: '3'", "seed: '2'"))
    with pytest.raises(BagError, match="copies of the run's metadata differ"):
        BagReader(tmp_path / "run")
    report = recover(tmp_path / "run")
    with BagReader(report.output) as reader:
        assert reader.metadata == {"recovered_from": "run", "seed": "3", "name": "x"}
    whole.unlink()
    shutil.rmtree(report.output)
    (file,) = (tmp_path / "run").glob("*.mcap")
    file.write_bytes(file.read_bytes().replace(b"seed: '3'", b"seed: '2'"))
    report = recover(tmp_path / "run")
    assert report.doubtful == ["seed"]
    assert "left out of the run's metadata, unproven: seed" in str(report)
    with BagReader(report.output) as reader:
        assert reader.metadata == {"recovered_from": "run", "name": "x"}


@pytest.mark.parametrize("name", ["run_0.mcap", "metadata.yaml"])
def test_a_pipe_in_place_of_a_file_is_refused(tmp_path: Path, name: str) -> None:
    write(tmp_path / "run")
    (tmp_path / "run" / name).unlink()
    os.mkfifo(tmp_path / "run" / name)
    with pytest.raises(BagError, match=r"not a regular file|not a bag"):
        BagReader(tmp_path / "run")
    if name == "run_0.mcap":
        with pytest.raises(BagError, match="not a regular file"):
            recover(tmp_path / "run")
        with pytest.raises(BagError, match="not a regular file"):
            recover(tmp_path / "run" / name)
        with pytest.raises(BagError, match="not a regular file"):
            BagReader(tmp_path / "run" / name)


def test_a_sparse_file_larger_than_the_memory(
    tmp_path: Path, original: tuple[bytes, Counter]
) -> None:
    """Of 20 GB nothing is read into memory; the messages before the hole are saved."""
    data, messages = original
    folder = damaged(tmp_path, data[:-50])
    file = folder / "run_0.mcap"
    with file.open("r+b") as stream:
        stream.truncate(20 * 10**9)
    with pytest.raises(BagError, match="no sound index"):
        BagReader(file)
    report = recover(folder)
    assert content(report.output) == messages
    assert report.bytes_total == 20 * 10**9


def test_holes_are_not_searched(tmp_path: Path, original: tuple[bytes, Counter]) -> None:
    """Four terabytes of zeros, with the last chunk behind them, and nothing but zeros: to read
    them would take an hour."""
    data, messages = original
    *_, (last, length) = chunk_offsets(data, tmp_path)
    folder = damaged(tmp_path, data[:last])
    with (folder / "run_0.mcap").open("r+b") as stream:
        stream.seek(4 * 10**12)
        stream.write(data[last : last + length])
    report = recover(folder)
    assert content(report.output) == messages
    assert report.bytes_total == 4 * 10**12 + length
    with (tmp_path / "zeros.mcap").open("wb") as stream:
        stream.truncate(4 * 10**12)
    with pytest.raises(BagError, match="nothing"):
        recover(tmp_path / "zeros.mcap")


def test_a_few_bytes_that_unpack_to_gigabytes(tmp_path: Path) -> None:
    bomb = zstandard.compress(bytes(2**20)) * 3
    for size in (2**40, 2**20):
        chunk = SimpleNamespace(
            compression="zstd", data=bomb, uncompressed_size=size, uncompressed_crc=0
        )
        if size == 2**20:
            assert unpack(chunk) == bytes(size)
        else:
            with pytest.raises(ValueError, match="promises 1099511627776 bytes"):
                unpack(chunk)
    short = SimpleNamespace(
        compression="zstd",
        data=zstandard.compress(bytes(10**8)),
        uncompressed_size=1000,
        uncompressed_crc=0,
    )
    with pytest.raises(ValueError, match="holds 1001 bytes, not 1000"):
        unpack(short)
