#!/usr/bin/env python3
"""What the mcap package and rosbags do of what netpos.bags does: speed, and damaged files.

    scripts/compare_mcap.py

The figures are those of docs/decisions/0094.
"""

from __future__ import annotations

import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from netpos.bags import BagReader, BagWriter
from netpos.bags.recover import recover
from rosbags.rosbag2 import Reader

sys.path.insert(0, str(Path(__file__).parent))
import fuzz

BAGS = 100
MESSAGES = 100_000


def kept_by_mcap(data: bytes) -> Counter:
    """Messages up to the first error, with checksums looked at."""
    messages, channels, schemas = Counter(), {}, {}
    try:
        for record in StreamReader(BytesIO(data), validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                name = schemas[channel.schema_id]
                messages[channel.topic, name, record.log_time, record.data] += 1
    except Exception:
        return messages
    return messages


def kept_by_recover(bag: Path) -> Counter:
    """Messages of the recovered bag."""
    try:
        return fuzz.content(recover(bag).output or bag)[0]
    except ValueError:
        return Counter()


def damaged_files(bag: Path, root: Path) -> None:
    """Shares kept of files with flipped bits."""
    (file,) = bag.glob("*.mcap")
    data, original = file.read_bytes(), fuzz.content(bag)[0]
    for flips in (1, 10, 50):
        kept = {"mcap": 0, "recover": 0}
        wrong = Counter()
        for seed in range(BAGS):
            rng, bad = random.Random(seed), bytearray(data)
            for _ in range(flips):
                bad[rng.randrange(len(bad))] ^= 1 << rng.randrange(8)
            folder = root / "damaged"
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(bag, folder / bag.name)
            (folder / bag.name / file.name).write_bytes(bad)
            for name, messages in (
                ("mcap", kept_by_mcap(bytes(bad))),
                ("recover", kept_by_recover(folder / bag.name)),
            ):
                kept[name] += (messages & original).total()
                wrong[name] += bool(messages - original)
        for name, count in kept.items():
            share = 100.0 * count / original.total() / BAGS
            print(f"{flips} flips, {name}: {share:.1f} % kept, wrong in {wrong[name]} bags")


def timed(name: str, work: Callable[[], object]) -> None:
    """Print the time of ``work`` per message."""
    begin = time.perf_counter()
    work()
    print(f"{name}: {(time.perf_counter() - begin) / MESSAGES * 1e6:.1f} us a message")


def speed(bag: Path, root: Path) -> None:
    """Writing and reading."""
    entries = fuzz.recorded(bag)
    big = root / "big"

    def write() -> None:
        with BagWriter(big) as writer:
            for i in range(MESSAGES):
                writer.write_raw(*entries[i % len(entries)], i * 1000)

    def write_plainly() -> None:
        with (root / "plain.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            channel = writer.register_channel("/x", "cdr", 0)
            for i in range(MESSAGES):
                writer.add_message(channel, i, entries[i % len(entries)][2], i)
            writer.finish()

    def read() -> None:
        with BagReader(big) as reader:
            assert sum(1 for _ in reader.messages()) == MESSAGES

    def read_by_mcap() -> None:
        with (big / "big_0.mcap").open("rb") as stream:
            messages = make_reader(stream, validate_crcs=True).iter_messages()
            assert sum(1 for _ in messages) == MESSAGES

    def read_by_rosbags() -> None:
        with Reader(big) as reader:
            assert sum(1 for _ in reader.messages()) == MESSAGES

    timed("write, netpos", write)
    timed("write, mcap", write_plainly)
    timed("read, netpos", read)
    timed("read, mcap", read_by_mcap)
    timed("read, rosbags", read_by_rosbags)


def main() -> None:
    """Print both."""
    with tempfile.TemporaryDirectory() as folder:
        bag = fuzz.example(Path(folder))
        speed(bag, Path(folder))
        damaged_files(bag, Path(folder))


if __name__ == "__main__":
    main()
