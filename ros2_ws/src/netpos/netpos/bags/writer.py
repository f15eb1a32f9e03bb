"""Write bags that ``ros2 bag``, rosbags, mcap and Foxglove open."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from mcap.writer import CompressionType
from rosbags.interfaces import Qos

import netpos
from netpos.bags import layout
from netpos.bags.chunks import FastWriter
from netpos.bags.errors import BagError
from netpos.bags.qos import default_profile
from netpos.bags.types import check_type_name, definition, require_type, type_hash

CHUNK_BYTES = 1024 * 1024  # of uncompressed messages
MAX_TIME_NS = 2**63 - 1


class BagWriter:
    """One new bag folder. The same calls give the same bytes: no clock or host enters the file.

    Chunks carry a CRC and are written as soon as they are full; a live recorder also calls
    ``flush`` on a timer, so that a kill loses no more than its period. Closing finishes the bag
    also after an exception: what was written is kept. Definitions are repeated in attachments,
    which carry a CRC of their own, so that recovery does not depend on the first chunk.

    Parameters
    ----------
    path : folder to create; its parents are created too
    metadata : what made the bag (scenario text, seed, version); also kept in metadata.yaml

    Raises
    ------
    FileExistsError  the path exists: a recording is never overwritten
    """

    def __init__(self, path: Path, *, metadata: Mapping[str, str] | None = None) -> None:
        self.path = Path(path)
        self._abandoned = False
        self._run = {str(key): str(value) for key, value in (metadata or {}).items()}
        self._topics: dict[str, layout.Topic] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        try:
            self.path.mkdir(parents=True)
        except FileExistsError:
            raise FileExistsError(
                f"{self.path} exists and recordings are never overwritten; choose another name"
            ) from None
        file = layout.storage_file(self.path.absolute())
        self._file = file.open("xb")
        try:
            # Without a name: what is killed leaves nothing behind.
            self._spool: IO[bytes] = tempfile.TemporaryFile(dir=self.path)  # noqa: SIM115
            self._mcap = FastWriter(
                self._file, self._spool, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD
            )
            self._mcap.start(profile="ros2", library=f"{layout.LIBRARY} {netpos.__version__}")
            if self._run:
                self._say_of_run(self._run)
            with self._writing():
                self._file.flush()
        except OSError:
            shutil.rmtree(self.path)  # it holds nothing yet
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, per topic."""
        return {topic.name: topic.count for topic in self._topics.values()}

    def add_topic(
        self,
        topic: str,
        type_name: str,
        qos: Qos | list[Qos] | None = None,
        *,
        text: str | None = None,
    ) -> None:
        """Announce a topic; does nothing where it is known with the same type.

        Parameters
        ----------
        qos : profile or profiles its publishers offer (default: what netpos' nodes offer)
        text : full definition of the type (default: found in the ROS installation)

        Raises
        ------
        BagError  the type is unknown, or the topic is there with another one
        """
        known = self._topics.get(topic)
        if known is not None:
            if known.type_name != type_name:
                raise BagError(
                    f"{topic} is recorded as {known.type_name} and cannot also hold {type_name}; "
                    "record one of them under another name"
                )
            return
        check_type_name(type_name)
        text = definition(type_name) if text is None else text
        if qos is None:
            qos = default_profile(topic)
        entry = layout.Topic(
            name=topic,
            type_name=type_name,
            profiles=[qos] if isinstance(qos, Qos) else list(qos),
            definition=text,
            type_hash=type_hash(type_name, text),
        )
        schema = self._schemas.get((type_name, text))
        if schema is None:
            schema = self._mcap.register_schema(type_name, "ros2msg", text.encode())
            self._schemas[type_name, text] = schema
        entry.channel_id = self._mcap.register_channel(
            topic,
            "cdr",
            schema,
            layout.channel_metadata(entry),
        )
        self._topics[topic] = entry
        self._repeat_definition(entry, schema)

    def _repeat_definition(self, entry: layout.Topic, schema_id: int) -> None:
        copy = layout.definition_records(entry, schema_id)
        with self._writing():
            self._mcap.add_attachment(0, 0, layout.DEFINITION_ATTACHMENT, "application/zstd", copy)
            self._file.flush()

    def write(self, topic: str, message: Any, log_time_ns: int) -> None:
        """Serialise and append one rosbags message; its topic is added on first use."""
        type_name = str(message.__msgtype__)
        cdr = require_type(type_name).serialize_cdr(message, type_name)
        self.write_raw(topic, type_name, bytes(cdr), log_time_ns)

    def write_raw(
        self,
        topic: str,
        type_name: str,
        cdr: bytes,
        log_time_ns: int,
        publish_time_ns: int | None = None,
    ) -> None:
        """Append one serialised message; its topic is added on first use.

        Raises
        ------
        BagError  unknown type, topic recorded with another type, no CDR header, time out of range
        """
        entry = self._topics.get(topic)
        if entry is None or entry.type_name != type_name:
            self.add_topic(topic, type_name)
            entry = self._topics[topic]
        if not 0 <= log_time_ns <= MAX_TIME_NS:
            raise BagError(f"{topic}: log time {log_time_ns} ns is outside [0, 2^63 - 1]")
        if len(cdr) < 4:
            raise BagError(f"{topic}: {len(cdr)} bytes are no serialised message")
        try:
            self._mcap.add_message(
                entry.channel_id,
                log_time_ns,
                cdr,
                log_time_ns if publish_time_ns is None else publish_time_ns,
                entry.count & 0xFFFFFFFF,
            )
        except OSError as error:
            raise self._not_written(error) from error
        entry.count += 1

    def note(self, key: str, value: str) -> None:
        """Add facts to the metadata that are known only now."""
        self._run[key] = value
        self._say_of_run({key: value})

    def _say_of_run(self, run: Mapping[str, str]) -> None:
        """Write the facts of the run in a record that readers know, and under a checksum."""
        copy = layout.run_records(run)
        with self._writing():
            self._mcap.add_metadata(layout.RUN_RECORD, dict(run))
            self._mcap.add_attachment(0, 0, layout.RUN_ATTACHMENT, "application/zstd", copy)
            self._file.flush()

    def flush(self) -> None:
        """Close the chunk in progress and hand everything to the operating system."""
        with self._writing():
            self._mcap.flush()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._not_written(error) from error

    def _not_written(self, error: OSError) -> OSError:
        """The error of a write, with the name of the bag; nothing more is written then."""
        self.abandon()
        return OSError(error.errno, os.strerror(error.errno or 0), str(self.path))

    @property
    def closed(self) -> bool:
        """Whether nothing more can be written."""
        return self._file.closed

    def abandon(self) -> None:
        """Close the file as it is, without an index: ``recover`` saves its whole chunks."""
        self._abandoned = True
        for file in (self._file, self._spool):
            with suppress(OSError):  # what waits in the buffer of the file does not fit either
                file.close()

    def close(self) -> None:
        """Write the index and metadata.yaml; may be called twice."""
        if self._file.closed or self._abandoned:
            return
        name = layout.storage_file(self.path.absolute()).name
        try:
            self._mcap.flush()
            information = layout.describe(
                name, self._topics.values(), *self._mcap.time_span(), self._run
            )
            self._mcap.add_metadata(
                layout.ROSBAG2_RECORD, {"serialized_metadata": layout.dump(information)}
            )
            self._mcap.finish()
            self._file.close()
        except OSError as error:
            raise self._not_written(error) from error
        finally:
            for file in (self._file, self._spool):
                with suppress(OSError):
                    file.close()
        layout.write_metadata(self.path, information)


@contextmanager
def whole_bag(path: Path, *, metadata: Mapping[str, str] | None = None) -> Iterator[BagWriter]:
    """A ``BagWriter`` of what is made from another recording: where the block does not end well,
    Ctrl-C included, no bag is left that looks finished.

    Raises ``FileExistsError`` where the path exists, which then stays as it is.
    """
    writer = BagWriter(path, metadata=metadata)
    try:
        with writer:
            yield writer
    except BaseException:
        shutil.rmtree(writer.path)
        raise
