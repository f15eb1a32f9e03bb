"""The messages of MCAP files, read and written chunk by chunk.

The libraries handle them one by one, at several times the cost. What is written is byte for byte
what mcap's own writer gives, what is read is what rosbags gives.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Container, Iterator, Mapping
from io import BytesIO
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import Writer

from netpos.bags.scan import unpack

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_INDEX = struct.Struct("<BQHI")
_PART_BYTES = 1 << 20
_FIXED = _MESSAGE.size - _HEAD.size  # bytes of a message's record between its length and its data

StoredMessage = tuple[int, int, str, bytes]  # log time, position in the file, topic, payload


def messages_in_order(storage: Any, topics: Mapping[int, str]) -> Iterator[StoredMessage]:
    """Messages of an indexed file in log-time order, ties in the order of the file.

    ``storage`` is the file, opened by rosbags or ``SingleFile``; ``topics`` those wanted, by
    channel.

    Raises
    ------
    ValueError, struct.error, EOFError  a chunk is damaged
    """
    waiting: list[StoredMessage] = []
    chunks = sorted(enumerate(storage.chunks), key=lambda item: item[1].message_start_time)
    for number, chunk in chunks:
        if not chunk.message_index_offsets or topics.keys() & chunk.message_index_offsets:
            due = bisect_left(waiting, (chunk.message_start_time,))
            yield from waiting[:due]
            waiting = sorted(waiting[due:] + _messages_of(storage.bio, chunk, number, topics))
    yield from waiting


def _messages_of(
    file: Any, chunk: Any, number: int, topics: Mapping[int, str]
) -> list[StoredMessage]:
    file.seek(chunk.chunk_start_offset + _HEAD.size)
    record = Chunk.read(ReadDataStream(BytesIO(file.read(chunk.chunk_length - _HEAD.size))))
    raw = unpack(record)
    # Without a checksum, records that follow one another to the end are the only proof of them.
    sound = record.uncompressed_crc and chunk.message_index_offsets
    offsets = _indexed(file, chunk, topics) if sound else _walked(raw)
    messages: list[StoredMessage] = []
    chunk_position = number << 40
    for offset in offsets:
        opcode, size, channel, _, time, _ = _MESSAGE.unpack_from(raw, offset)
        end = offset + _HEAD.size + size
        if opcode != Opcode.MESSAGE or end > len(raw):
            raise ValueError("the index of a chunk does not fit it")
        if channel in topics:
            messages.append(
                (time, chunk_position + offset, topics[channel], raw[offset + _MESSAGE.size : end])
            )
    return messages


def _indexed(file: Any, chunk: Any, channels: Container[int]) -> set[int]:
    """Offsets of the messages of ``channels`` in the records of a chunk, from its index."""
    positions: set[int] = set()
    for channel, offset in chunk.message_index_offsets.items():
        if channel not in channels:
            continue
        file.seek(offset)
        opcode, _, owner, size = _INDEX.unpack(file.read(_INDEX.size))
        if (opcode, owner) != (Opcode.MESSAGE_INDEX, channel):
            raise ValueError("a chunk has no index where it should be")
        positions.update(struct.unpack(f"<{size // 8}Q", file.read(size))[1::2])
    return positions


def _walked(raw: bytes) -> set[int]:
    """Offsets of the messages in the records of a chunk."""
    positions: set[int] = set()
    position = 0
    while position < len(raw):
        opcode, size = _HEAD.unpack_from(raw, position)
        if opcode == Opcode.MESSAGE:
            positions.add(position)
        position += _HEAD.size + size
    if position != len(raw):
        raise ValueError("a record exceeds its chunk")
    return positions


class _Index:
    """Record that finds the messages of one channel in a chunk: log time, offset, log time, ..."""

    __slots__ = ("channel_id", "pairs")

    def __init__(self, channel_id: int, pairs: list[int]) -> None:
        self.channel_id = channel_id
        self.pairs = pairs

    def write(self, records: Any) -> None:
        """As mcap's MessageIndex."""
        records.start_record(Opcode.MESSAGE_INDEX)
        records.write2(self.channel_id)
        records.write4(8 * len(self.pairs))
        records.write(struct.pack(f"<{len(self.pairs)}Q", *self.pairs))
        records.finish_record()


class _Chunk:
    """Replaces mcap's builder of chunks; has the attributes that its writer uses."""

    def __init__(self, statistics: Any) -> None:
        self._statistics = statistics  # of the file, brought up to date with each whole chunk
        self.reset()

    def reset(self) -> None:
        self.count = 0  # bytes
        self.num_messages = 0
        self.message_start_time = 0
        self.message_end_time = 0
        self.message_indices: dict[int, _Index] = {}
        self._parts: list[bytes] = []
        self._pairs: defaultdict[int, list[int]] = defaultdict(list)

    def add_schema(self, schema: Any) -> None:
        records = RecordBuilder()
        schema.write(records)
        self._parts.append(records.end())
        self.count += len(self._parts[-1])

    add_channel = add_schema

    def add(self, channel_id: int, log_time: int, data: bytes, publish: int, seq: int) -> None:
        size = _FIXED + len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, size, channel_id, seq, log_time, publish)
        self._parts += (head, data)
        self._pairs[channel_id] += (log_time, self.count)
        self.count += 9 + size
        self.num_messages += 1

    def end(self) -> bytes:
        """The records; the index and the statistics are complete from here on."""
        times = [time for pairs in self._pairs.values() for time in pairs[::2]]
        self.message_start_time, self.message_end_time = min(times), max(times)
        self.message_indices = {c: _Index(c, pairs) for c, pairs in self._pairs.items()}
        total = self._statistics
        first = total.message_count == 0
        start = self.message_start_time
        total.message_start_time = start if first else min(start, total.message_start_time)
        total.message_end_time = max(self.message_end_time, total.message_end_time)
        total.message_count += self.num_messages
        for channel_id, pairs in self._pairs.items():
            total.channel_message_counts[channel_id] += len(pairs) // 2
        return b"".join(self._parts)


class _Spool:
    """The index of every chunk, which a file has at its end: a recording has four of them each
    second, so they wait in a file of their own. Replaces a list of mcap's writer."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def append(self, index: Any) -> None:
        records = RecordBuilder()
        index.write(records)
        self._file.write(records.end())

    def __iter__(self) -> Iterator[_Spool]:
        self._file.seek(0)
        yield self

    def write(self, records: Any) -> None:
        """All of them, as mcap's ChunkIndex writes one."""
        while part := self._file.read(_PART_BYTES):
            records.write(part)


class FastWriter(Writer):  # type: ignore[misc]  # mcap has no types
    """mcap's Writer; a chunk is written when it exceeds ``chunk_size`` bytes. ``spool``: an empty
    file, to write and read, in which the index waits for the end."""

    def __init__(
        self, stream: BinaryIO, spool: BinaryIO, *, chunk_size: int, **options: Any
    ) -> None:
        super().__init__(stream, chunk_size=chunk_size, **options)
        self._size = chunk_size
        self._statistics = self._Writer__statistics
        self._chunk = _Chunk(self._statistics)
        self._Writer__chunk_builder = self._chunk
        self._Writer__chunk_indices = _Spool(spool)

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Append a message to the chunk in progress."""
        self._chunk.add(channel_id, log_time, data, publish_time, sequence)
        if self._chunk.count > self._size:
            self.flush()

    def time_span(self) -> tuple[int, int]:
        """First and last log time of all chunks written so far; 0, 0 before any."""
        return self._statistics.message_start_time, self._statistics.message_end_time
