"""Walk the records of an MCAP file that may be cut off or damaged.

A record counts only if encoding it again gives the same bytes; a chunk or an attachment only if
its CRC is right as well. Where that fails, the walk goes on at the next place that holds a sound
chunk or attachment.

A file that makes checksums is held to them: what none covers counts as lost.
"""

from __future__ import annotations

import os
import struct
import zlib
from bisect import bisect
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from itertools import islice
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from netpos.bags.layout import DEFINITION_ATTACHMENT, LIBRARY, RUN_ATTACHMENT, RUN_RECORD

_HEAD = struct.Struct("<BQ")
RECORD_MAX = 2**28  # bytes; chunks and messages are far smaller, damaged lengths are not
_ATTACHMENTS = (DEFINITION_ATTACHMENT, RUN_ATTACHMENT)
_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT: Attachment,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.DATA_END: DataEnd,
}


@dataclass(slots=True)
class Scan:
    """Result of a walk; sizes in bytes. Chunks are found again in ``data``, which stays open."""

    data: bytes | mmap
    schemas: dict[int, Any] = field(default_factory=dict)
    channels: dict[int, Any] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    proven_run: dict[str, str] = field(default_factory=dict)  # of the run, under a checksum
    blocks: list[tuple[Any, bool]] = field(default_factory=list)  # place or Message, verified
    loose: list[Any] = field(default_factory=list)  # messages outside of chunks
    library: str = LIBRARY  # who wrote the file; ours until its header says otherwise
    complete: bool = False  # footer and closing magic are in place
    damaged_places: int = 0
    bytes_dropped: int = 0
    _certain: set[tuple[type, int]] = field(default_factory=set)

    @property
    def checked(self) -> bool:
        """Whether the file has checksums: at least one in it is right."""
        return bool(self._certain) or any(verified for _, verified in self.blocks)

    def messages(self) -> Iterator[tuple[Any, bool]]:
        """(mcap Message, covered by a checksum) in the order of the file.

        Messages outside of chunks count only in files of writers that make no chunks: elsewhere
        they are a damaged record of another kind.
        """
        if not self.blocks and not self.library.startswith(LIBRARY):
            yield from ((message, False) for message in self.loose)
        for block, verified in self.blocks:
            if isinstance(block, Message):
                yield block, verified
                continue
            for record in records_inside(unpack(_record(self.data, Opcode.CHUNK, *block))):
                if isinstance(record, Message):
                    yield record, verified

    def define(self, record: Any, verified: bool) -> None:
        """Note a schema or channel; a copy under a checksum wins over others."""
        table = self.schemas if isinstance(record, Schema) else self.channels
        key = (type(record), record.id)
        if record.id not in table or (verified and key not in self._certain):
            table[record.id] = record
        if verified:
            self._certain.add(key)

    def is_certain(self, channel: Any) -> bool:
        """Whether a checksum covers a channel and its schema."""
        return {(Channel, channel.id), (Schema, channel.schema_id)} <= self._certain


class _SparseFile(mmap):
    """A file whose holes are not searched: nothing but zeros would be found there."""

    extents: list[tuple[int, int]]

    def find(self, mark: Any, position: int = 0, end: int | None = None) -> int:
        """Offset of a ``mark`` of one byte that is not zero, -1 if there is none."""
        until = len(self) if end is None else end
        begin = max(bisect(self.extents, (position,)) - 1, 0)
        for first, last in islice(self.extents, begin, None):
            found = super().find(mark, max(first, position), min(last, until))
            if found >= 0:
                return found
        return -1


def _extents(descriptor: int, size: int) -> list[tuple[int, int]]:
    """Where a file holds data: offsets of the beginning and the end of each part."""
    extents, end = [], 0
    while end < size:
        try:
            start = os.lseek(descriptor, end, os.SEEK_DATA)
        except OSError:  # nothing but a hole
            break
        end = os.lseek(descriptor, start, os.SEEK_HOLE)
        extents.append((start, end))
    return extents


@contextmanager
def content_of(file: Path) -> Iterator[bytes | mmap]:
    """The bytes of a file, which may be larger than the memory."""
    with file.open("rb") as stream:
        if not file.stat().st_size:
            yield b""
            return
        with _SparseFile(stream.fileno(), 0, access=ACCESS_READ) as data:
            data.extents = _extents(stream.fileno(), len(data))
            yield data


def _record(data: bytes | mmap, opcode: int, start: int, length: int) -> Any:
    """The record whose body is ``data[start : start + length]``, or None where it is not sound."""
    if length > RECORD_MAX:
        return None
    body = data[start : start + length]
    stream = ReadDataStream(BytesIO(body))
    try:
        if opcode == Opcode.MESSAGE:
            return Message.read(stream, length) if length > 22 else None
        kind = _KINDS.get(opcode)
        if kind is None:
            return None
        record = kind.read(stream)
        again = RecordBuilder()
        record.write(again)
    except Exception:  # damaged bytes raise nearly anything
        return None
    return record if again.end()[_HEAD.size :] == body else None


def unpack(chunk: Any) -> bytes:
    """Records of a chunk, uncompressed.

    Raises
    ------
    ValueError  unknown compression, broken stream, wrong or absurd size, or wrong CRC (0: the
        chunk has none)
    """
    size = chunk.uncompressed_size
    if size > RECORD_MAX:
        raise ValueError(f"chunk promises {size} bytes, at most {RECORD_MAX} are read")
    try:
        raw = _uncompressed(chunk, size + 1)  # a byte more than promised would be one too many
    except Exception as error:  # damaged bytes raise nearly anything
        raise ValueError(f"chunk cannot be uncompressed: {error}") from error
    if len(raw) != chunk.uncompressed_size:
        raise ValueError(f"chunk holds {len(raw)} bytes, not {chunk.uncompressed_size}")
    if chunk.uncompressed_crc and zlib.crc32(raw) != chunk.uncompressed_crc:
        raise ValueError("chunk has a wrong CRC")
    return bytes(raw)


def _uncompressed(chunk: Any, limit: int) -> bytes:
    """At most ``limit`` bytes: a few kB may describe gigabytes."""
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            return bytes(stream.read(limit))
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=limit))
    if chunk.compression == "":
        return bytes(chunk.data)
    raise ValueError(f"unknown compression {chunk.compression!r}")


def records_inside(raw: bytes) -> Iterator[Any]:
    """Schemas, channels and messages of an unpacked chunk, up to the first that is not sound."""
    position = 0
    while position + _HEAD.size <= len(raw):
        opcode, length = _HEAD.unpack_from(raw, position)
        position += _HEAD.size
        if position + length > len(raw):
            return
        record = _record(raw, opcode, position, length)
        if record is None:
            return
        yield record
        position += length


def _is_proven(data: bytes | mmap, position: int) -> bool:
    """Whether a chunk or an attachment of ours begins here whose CRC is right."""
    if position + _HEAD.size > len(data):
        return False
    opcode, length = _HEAD.unpack_from(data, position)
    start = position + _HEAD.size
    if start + length > len(data):
        return False
    record = _record(data, opcode, start, length)
    if isinstance(record, Chunk):
        return bool(record.uncompressed_crc) and _unpacks(record)
    return isinstance(record, Attachment) and record.name in _ATTACHMENTS


def _unpacks(chunk: Any) -> bool:
    try:
        unpack(chunk)
    except ValueError:
        return False
    return True


def _next_proven(data: bytes | mmap, position: int) -> int:
    """Offset of the next sound chunk or attachment at or after ``position``; the end of the data
    if none."""
    marks = {bytes([opcode]): -1 for opcode in (Opcode.CHUNK, Opcode.ATTACHMENT)}
    while position < len(data):
        for mark, mark_position in marks.items():
            if mark_position < position:
                next_position = data.find(mark, position)
                marks[mark] = next_position if next_position >= 0 else len(data)
        position = min(marks.values())
        if _is_proven(data, position):
            return position
        position += 1
    return len(data)


def scan(data: bytes | mmap) -> Scan:
    """Everything sound in the bytes of an MCAP file; no content of the bytes raises."""
    result = Scan(data)
    position = len(MCAP0_MAGIC) if data[: len(MCAP0_MAGIC)] == MCAP0_MAGIC else 0
    while position < len(data):
        if result.complete and data[position : position + 99] == MCAP0_MAGIC:
            return result
        size = 0 if result.complete else _take(result, position)
        if size == 0:
            result.complete = False
            following = _next_proven(data, position + 1)
            result.damaged_places += 1
            result.bytes_dropped += following - position
            position = following
        position += size
    result.complete = False
    return result


def _take(result: Scan, position: int) -> int:
    """Note the record at ``position``; its whole size, or 0 where it is not sound."""
    data = result.data
    if position + _HEAD.size > len(data):
        return 0
    opcode, length = _HEAD.unpack_from(data, position)
    start = position + _HEAD.size
    if start + length > len(data):
        if opcode == Opcode.CHUNK:
            _take_cut_chunk(result, start, length)
        return 0
    record = _record(data, opcode, start, length)
    if record is None:
        return 0
    if isinstance(record, Chunk):
        if not _take_chunk(result, record, (start, length)):
            return 0
    elif isinstance(record, Message):
        result.loose.append(record)
    elif isinstance(record, Header):
        result.library = record.library
    elif isinstance(record, (Schema, Channel)):
        result.define(record, verified=False)
    elif isinstance(record, Metadata):
        result.metadata.setdefault(record.name, {}).update(record.metadata)
    elif isinstance(record, Attachment) and record.name in _ATTACHMENTS:
        _take_copy(result, record.data)
    elif isinstance(record, Footer):
        _take_summary(result, record, start)
    result.complete = isinstance(record, Footer)
    return _HEAD.size + int(length)


def _take_copy(result: Scan, compressed: bytes) -> None:
    """A copy of a topic's schema and channel, or of the facts of the run; the attachment's CRC
    was checked with the record."""
    try:
        with zstandard.ZstdDecompressor().stream_reader(compressed) as stream:
            raw = stream.read(RECORD_MAX)
    except zstandard.ZstdError:
        return
    for record in records_inside(raw):
        if isinstance(record, (Schema, Channel)):
            result.define(record, verified=True)
        elif isinstance(record, Metadata) and record.name == RUN_RECORD:
            result.proven_run.update(record.metadata)


def run_of_attachments(stream: IO[bytes], index: Iterable[Any]) -> dict[str, str]:
    """Facts of the run in the attachments of an indexed file; ValueError where one is damaged."""
    result = Scan(b"")
    for entry in index:
        if entry.name != RUN_ATTACHMENT:
            continue
        stream.seek(entry.offset + _HEAD.size)
        body = stream.read(min(entry.length - _HEAD.size, RECORD_MAX))
        attachment = _record(body, Opcode.ATTACHMENT, 0, len(body))
        if attachment is None:
            raise ValueError("the facts of the run have a wrong CRC")
        _take_copy(result, attachment.data)
    return result.proven_run


def _take_summary(result: Scan, footer: Any, start: int) -> None:
    """Records that the index repeats are proven if its CRC is right."""
    end = start + 16  # of what the CRC covers: all of the footer but the CRC itself
    first = footer.summary_start
    if not footer.summary_crc or not 0 < first < end or end - first > RECORD_MAX:
        return
    summary = result.data[first:end]
    if zlib.crc32(summary) != footer.summary_crc:
        return
    for record in records_inside(summary):
        if isinstance(record, (Schema, Channel)):
            result.define(record, verified=True)


def _take_chunk(result: Scan, chunk: Any, extent: tuple[int, int]) -> bool:
    try:
        raw = unpack(chunk)
    except ValueError:
        return False
    verified = bool(chunk.uncompressed_crc)
    for record in records_inside(raw):
        if isinstance(record, (Schema, Channel)):
            result.define(record, verified)
    result.blocks.append((extent, verified))
    return True


def _take_cut_chunk(result: Scan, start: int, length: int) -> None:
    """Keep the whole messages of a last, uncompressed chunk that the end of the file cuts."""
    fixed = struct.Struct("<QQQII")
    if len(result.data) - start < fixed.size + 8 or length > RECORD_MAX:
        return
    body = result.data[start:]
    size, compression = fixed.unpack_from(body)[2], fixed.unpack_from(body)[4]
    (stored,) = struct.unpack_from("<Q", body, fixed.size)
    if compression != 0 or stored != size or length != fixed.size + 8 + size:
        return
    for record in records_inside(body[fixed.size + 8 :]):
        if isinstance(record, (Schema, Channel)):
            result.define(record, verified=False)
        elif isinstance(record, Message):
            result.blocks.append((record, False))


def summary_is_sound(file: Path) -> bool:
    """False where the closing magic, the footer or the summary's CRC (if it has one) is wrong."""
    size, footer_size = file.stat().st_size, _HEAD.size + 20
    with file.open("rb") as stream:
        stream.seek(max(0, size - footer_size - len(MCAP0_MAGIC)))
        tail = stream.read()
        if len(tail) < footer_size + len(MCAP0_MAGIC) or not tail.endswith(MCAP0_MAGIC):
            return False
        if _HEAD.unpack_from(tail) != (Opcode.FOOTER, 20):
            return False
        footer = _record(tail, Opcode.FOOTER, _HEAD.size, 20)
        if footer.summary_crc == 0:
            return True
        end = size - len(MCAP0_MAGIC) - 4
        if not footer.summary_start < end or end - footer.summary_start > RECORD_MAX:
            return False
        stream.seek(footer.summary_start)
        summary = stream.read(end - footer.summary_start)
    return bool(zlib.crc32(summary) == footer.summary_crc)
