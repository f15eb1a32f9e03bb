"""Read bags in log-time order, and refuse what is incomplete."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.reader import make_reader
from rosbags.interfaces import Qos
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.serde import SerdeError

from netpos.bags import layout
from netpos.bags.chunks import StoredMessage, messages_in_order
from netpos.bags.errors import BagError, require_file
from netpos.bags.run_facts import run_of_description, run_of_records, texts
from netpos.bags.scan import run_of_attachments, summary_is_sound
from netpos.bags.single_file import open_single_file
from netpos.bags.types import require_type, store_of_definition
from netpos.common.yaml_text import YamlError, check_limits, read_text
from netpos.messages.topics import RUN_TOPICS


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicInfo:
    """One topic of a bag: its type, number of messages, offered profiles and full definition."""

    type_name: str
    count: int
    qos: list[Qos]
    definition: str


def _info(type_name: str, count: int, qos: list[Qos], definition: str) -> TopicInfo:
    return TopicInfo(type_name=type_name, count=count, qos=qos, definition=definition)


class BagEntry:
    """One recorded message; ``message`` is decoded when asked for."""

    __slots__ = ("_decode", "cdr", "log_time_ns", "topic", "type_name")

    def __init__(
        self,
        topic: str,
        type_name: str,
        log_time_ns: int,
        cdr: bytes,
        decode: Callable[[str, bytes], Any],
    ) -> None:
        self.topic = topic
        self.type_name = type_name
        self.log_time_ns = log_time_ns
        self.cdr = cdr
        self._decode = decode

    @property
    def message(self) -> Any:
        """The rosbags object; BagError where the bytes do not fit the type."""
        return self._decode(self.topic, self.cdr)


class BagReader:
    """A bag folder, or a single .mcap file.

    ``topics`` maps names to TopicInfo; ``start_ns`` and ``end_ns`` are the log times of the first
    and last message (0 in an empty bag); ``metadata`` is what the writer was given.

    Raises
    ------
    BagError  missing, cut off, damaged or not a bag; also later, where other messages come than
        the index promises
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._described: dict[str, str] | None = None
        self._check_path()
        self._file = open_single_file(self.path) if self.path.is_dir() else None
        if self._file is None:
            self._reader = self._open()
        try:
            self._describe()
        except BagError:
            self.close()
            raise
        except Exception as error:  # damaged bytes raise nearly anything
            self.close()
            raise self._damaged(error) from error

    def _describe(self) -> None:
        if self._file is not None:
            self.topics = {name: _info(*entry) for name, entry in self._file.topics.items()}
            self.start_ns, self.end_ns = self._file.start_ns, self._file.end_ns
            self.metadata = texts(self._file.custom)
            self._compare([self._file.file])
            return
        self.topics = self._describe_topics()
        empty = self._reader.message_count == 0
        self.start_ns = 0 if empty else int(self._reader.start_time)
        self.end_ns = 0 if empty else int(self._reader.end_time) - 1
        self.metadata = self._run_metadata()
        storages = getattr(self._reader.storage, "storages", [self._reader.storage])
        paths = [Path(getattr(storage, "path", "")) for storage in storages]
        self._compare([path for path in paths if path.suffix == ".mcap"])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; may be called twice."""
        if self._file is not None:
            self._file.close()
        elif self._reader.is_open:
            self._reader.close()

    def _damaged(self, reason: object) -> BagError:
        text = str(reason).rstrip(".")
        return BagError(
            f"{self.path} is incomplete or damaged ({text}); try: netpos recover {self.path}"
        )

    def _check_path(self) -> None:
        if not self.path.exists():
            raise BagError(f"{self.path} does not exist; check the path of the bag")
        if self.path.is_dir() and not (self.path / layout.METADATA_FILE).exists():
            if any(self.path.glob("*.mcap")):
                raise self._damaged("its recorder did not finish")
            raise BagError(
                f"{self.path} is not a bag: it holds no {layout.METADATA_FILE} and no .mcap file"
            )
        self._check_metadata()
        self._check_summaries()

    def _check_metadata(self) -> None:
        """Check metadata.yaml before it is read."""
        file = self.path / layout.METADATA_FILE
        if not self.path.is_dir():
            return
        try:
            text = read_text(file)
            check_limits(text)
        except YamlError as error:
            raise self._damaged(f"{layout.METADATA_FILE}: {error}") from error
        self._described = run_of_description(text)

    def _open(self) -> Reader:
        try:
            reader = Reader(self.path)
        except ReaderError as error:
            raise BagError(
                f"{self.path} is not a bag ({error}); give a bag folder or an .mcap file"
            ) from error
        except Exception as error:  # as below
            raise self._damaged(error) from error
        try:
            reader.open()
        except Exception as error:  # damaged bytes raise nearly anything
            raise self._damaged(error) from error
        return reader

    def _check_summaries(self) -> None:
        """rosbags checks the chunks but not the index that names their topics and types."""
        files = sorted(self.path.glob("*.mcap")) if self.path.is_dir() else [self.path]
        for file in files:
            require_file(file)
            if file.suffix == ".mcap" and not summary_is_sound(file):
                raise self._damaged(f"{file.name} has no sound index")

    def _compare(self, files: list[Path]) -> None:
        """metadata.yaml and the records of the file have no checksum: all copies must agree."""
        for file in files:
            with file.open("rb") as stream:
                reader = make_reader(stream)
                index = reader.get_summary()
                ours = reader.get_header().library.startswith(layout.LIBRARY)
                records: dict[str, dict[str, str]] = {}
                for record in reader.iter_metadata() if ours else ():
                    records.setdefault(record.name, {}).update(record.metadata)
                known = index.attachment_indexes if index is not None and ours else ()
                attached = run_of_attachments(stream, known)
            copies = [*([attached] if attached else []), *run_of_records(records)]
            if ours and self._described is not None:
                copies.append(self._described)
            if len(files) == 1 and any(copy != copies[0] for copy in copies):
                raise self._damaged("its copies of the run's metadata differ")
            for channel in index.channels.values() if index is not None else ():
                info, schema = self.topics.get(channel.topic), index.schemas[channel.schema_id]
                if info is None or info.type_name != schema.name:
                    raise self._damaged(
                        f"{layout.METADATA_FILE} does not know {channel.topic} as {schema.name}"
                    )

    def _describe_topics(self) -> dict[str, TopicInfo]:
        topics: dict[str, TopicInfo] = {}
        for connection in self._reader.connections:
            known = topics.get(connection.topic)
            if known is not None and known.type_name != connection.msgtype:
                raise BagError(
                    f"{self.path}: {connection.topic} holds both {known.type_name} and "
                    f"{connection.msgtype}; split it first"
                )
            topics[connection.topic] = _info(
                connection.msgtype,
                connection.msgcount + (known.count if known else 0),
                list(getattr(connection.ext, "offered_qos_profiles", [])),
                connection.msgdef.data,
            )
        total = sum(topic.count for topic in topics.values())
        if total != self._reader.message_count:
            raise self._damaged(
                f"{self._reader.message_count} messages announced, its topics count {total}"
            )
        return topics

    def _run_metadata(self) -> dict[str, str]:
        if self.path.is_dir():
            return texts(getattr(self._reader.storage.metadata, "custom", None) or {})
        with self.path.open("rb") as stream:
            records = [
                record.metadata
                for record in make_reader(stream).iter_metadata()
                if record.name == layout.RUN_RECORD
            ]
        return {key: value for record in records for key, value in record.items()}

    @cached_property
    def facts(self) -> dict[str, tuple[str, ...]]:
        """Facts of the run, by name: the metadata, and what nodes published on its topics.

        Several values where they do not agree.
        """
        values_by_key = {key: [value] for key, value in self.metadata.items()}
        for entry in self.messages(self.topics.keys() & set(RUN_TOPICS)):
            message = entry.message
            values = values_by_key.setdefault(str(message.key), [])
            if message.value not in values:
                values.append(str(message.value))
        return {key: tuple(values) for key, values in values_by_key.items()}

    def decode(self, topic: str, cdr: bytes) -> Any:
        """A message of a topic; ``BagError`` where it is not of the topic's type."""
        info = self.topics[topic]
        if info.definition:
            store = store_of_definition(info.type_name, info.definition)
        else:
            store = require_type(info.type_name)
        try:
            return store.deserialize_cdr(cdr, info.type_name)
        except SerdeError as error:
            raise BagError(f"{self.path}: {topic}: {error}; was its type changed?") from error
        except (ValueError, KeyError, IndexError, struct.error, MemoryError) as error:
            raise BagError(
                f"{self.path}: {topic}: {len(cdr)} bytes are no {info.type_name} ({error})"
            ) from error

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagEntry]:
        """Messages of ``topics`` (default: all) in log-time order, ties in the order of recording.

        Raises
        ------
        BagError  a topic is not in the bag, or the bag holds other than the announced messages
        """
        if topics is not None:
            absent = sorted(set(topics) - self.topics.keys())
            if absent:
                raise BagError(
                    f"{self.path} has no topic {', '.join(absent)}; it holds "
                    f"{', '.join(sorted(self.topics)) or 'none'}"
                )
        names = self.topics.keys() if topics is None else set(topics)
        wanted = {name: self.topics[name] for name in names}
        stream = self._by_chunk(names) or self._by_message(names)
        counts = dict.fromkeys(names, 0)
        types, decode = {name: info.type_name for name, info in wanted.items()}, self.decode
        try:
            for log_time_ns, _, topic, cdr in stream:
                counts[topic] += 1
                yield BagEntry(topic, types[topic], log_time_ns, cdr, decode)
        except Exception as error:  # damaged bytes raise nearly anything
            raise self._damaged(error) from error
        for topic, info in wanted.items():
            if counts[topic] != info.count:
                raise self._damaged(f"{topic}: {counts[topic]} of {info.count} messages found")

    def _by_message(self, wanted: Collection[str]) -> Iterator[StoredMessage]:
        connections = [c for c in self._reader.connections if c.topic in wanted]
        if connections:  # rosbags takes none for all
            for connection, log_time_ns, cdr in self._reader.messages(connections):
                yield log_time_ns, 0, connection.topic, bytes(cdr)

    def _by_chunk(self, wanted: Collection[str]) -> Iterator[StoredMessage] | None:
        """The faster way, for a single MCAP file with an index."""
        if self._file is not None:
            wanted_by_channel = {c: t for c, t in self._file.channels.items() if t in wanted}
            return messages_in_order(self._file, wanted_by_channel)
        storages = getattr(self._reader.storage, "storages", [self._reader.storage])
        whole = self._reader.storage.metadata.compression_mode != "message"
        if len(storages) != 1 or not whole or not getattr(storages[0], "chunks", None):
            return None
        topics = {c.id: c.topic for c in storages[0].connections if c.topic in wanted}
        return messages_in_order(storages[0], topics)
