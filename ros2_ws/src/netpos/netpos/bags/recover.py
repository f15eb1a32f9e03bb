"""Save what a killed recorder or a bad disk left of a bag, and prove it."""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.rosbag2.metadata import parse_qos

from netpos.bags import layout
from netpos.bags.errors import BagError, require_file
from netpos.bags.reader import BagReader
from netpos.bags.run_facts import agreed, run_of_description, run_of_records
from netpos.bags.scan import Scan, content_of, scan
from netpos.bags.writer import BagWriter
from netpos.common.yaml_text import read_text

Checksums = dict[str, tuple[int, int]]
_MASK = 2**64 - 1


@dataclass(slots=True, kw_only=True)
class RecoveryReport:
    """What recovery did. ``output`` is None where the bag was fine: there was nothing to recover.

    counts : saved messages per topic, as read back from ``output`` (or found in the fine bag)
    unverified : saved messages of a file without checksums: nothing tells whether they are right
    unproven : messages left out because the file makes checksums and none covers them
    unknown : messages left out because nothing certain tells their topic or type
    doubtful : names of what was said of the run and is left out, as no copy confirms it
    bytes_total, bytes_dropped : of the damaged files; dropped are those of no sound record
    damaged_places : gaps the scan had to jump; one at the end is the cut itself
    """

    source: Path
    output: Path | None
    counts: dict[str, int]
    start_ns: int
    end_ns: int
    bytes_total: int
    bytes_dropped: int = 0
    damaged_places: int = 0
    unverified: int = 0
    unproven: int = 0
    unknown: int = 0
    doubtful: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """Saved messages of all topics."""
        return sum(self.counts.values())

    def __str__(self) -> str:
        if self.output is None:
            return f"{self.source} is complete ({self.messages} messages): nothing to recover"
        seconds = (self.end_ns - self.start_ns) / 1e9
        lines = [
            f"{self.output}: {self.messages} messages over {seconds:.3f} s, read back and equal",
            *(f"  {topic}: {count}" for topic, count in sorted(self.counts.items())),
            f"dropped {self.bytes_dropped} of {self.bytes_total} bytes "
            f"in {self.damaged_places} damaged places",
        ]
        if self.unverified:
            lines.append(f"{self.unverified} messages carry no checksum and may be damaged")
        if self.unproven:
            lines.append(f"{self.unproven} messages left out: no checksum proves them")
        if self.unknown:
            lines.append(f"{self.unknown} messages left out: their topic or type is lost")
        if self.doubtful:
            lines.append(f"left out of the run's metadata, unproven: {', '.join(self.doubtful)}")
        return "\n".join(lines + self.notes)


def checksums(path: Path) -> Checksums:
    """Per topic: number of messages and a checksum over log times and payloads, order-free.

    Raises
    ------
    BagError  the bag is not whole
    """
    sums: Checksums = {}
    with BagReader(path) as bag:
        sums = dict.fromkeys(bag.topics, (0, 0))
        for entry in bag.messages():
            _add(sums, entry.topic, entry.log_time_ns, entry.cdr)
    return sums


def _add(sums: Checksums, topic: str, log_time_ns: int, cdr: bytes) -> None:
    count, total = sums.get(topic, (0, 0))
    crc = zlib.crc32(cdr, zlib.crc32(log_time_ns.to_bytes(8, "little")))
    sums[topic] = (count + 1, (total + crc) & _MASK)


def recover(path: Path, output: Path | None = None) -> RecoveryReport:
    """Write the sound part of a bag to a new folder, then read it back and compare.

    Parameters
    ----------
    path : bag folder or .mcap file, cut off or damaged anywhere
    output : folder to create (default: NAME_recovered beside it)

    Raises
    ------
    BagError  nothing could be saved, or what was saved does not read back the same
    FileExistsError  ``output`` exists
    """
    path = Path(path)
    files = _files(path)
    report = _fine(path, files)
    if report is not None:
        return report
    if output is None:
        whole = path.absolute()
        name = whole.name if whole.is_dir() else whole.stem
        output = whole.with_name(f"{name}_recovered")
    if output.exists():
        raise FileExistsError(f"{output} exists and is not overwritten; move it away first")
    with ExitStack() as open_files:
        scans = [scan(open_files.enter_context(content_of(file))) for file in files]
        if not any(True for found in scans for _ in found.messages()):
            raise BagError(f"{path}: nothing could be saved, it holds no complete message")
        return _save(path, scans, output)


def _save(path: Path, scans: list[Scan], output: Path) -> RecoveryReport:
    report = RecoveryReport(
        source=path,
        output=output,
        counts={},
        start_ns=0,
        end_ns=0,
        bytes_total=sum(len(found.data) for found in scans),
        bytes_dropped=sum(found.bytes_dropped for found in scans),
        damaged_places=sum(found.damaged_places for found in scans),
    )
    try:
        _write(report, scans, output)
    except BaseException:
        shutil.rmtree(output, ignore_errors=True)  # made by this call
        raise
    return report


def _files(path: Path) -> list[Path]:
    if not path.exists():
        raise BagError(f"{path} does not exist; check the path of the bag")
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if not files:
        raise BagError(f"{path} holds no .mcap file; only MCAP bags can be recovered")
    for file in files:
        require_file(file)
    return sorted(files, key=lambda file: (len(file.name), file.name))


def _fine(path: Path, files: list[Path]) -> RecoveryReport | None:
    try:
        sums = checksums(path)
        with BagReader(path) as bag:
            start_ns, end_ns = bag.start_ns, bag.end_ns
    except BagError:
        return None
    return RecoveryReport(
        source=path,
        output=None,
        counts={topic: count for topic, (count, _) in sums.items()},
        start_ns=start_ns,
        end_ns=end_ns,
        bytes_total=sum(file.stat().st_size for file in files),
    )


def _run(report: RecoveryReport, scans: list[Scan]) -> dict[str, str]:
    """What is certain of the run: under a checksum, or said twice."""
    run: dict[str, str] = {}
    said = _description(report.source)
    for found in scans:
        copies = run_of_records(found.metadata) + ([said] if said else [])
        if not found.checked:
            run |= found.metadata.get(layout.RUN_RECORD, {})
            continue
        sure, doubtful = agreed(copies)
        run |= sure | found.proven_run
        report.doubtful += [key for key in doubtful if key not in run]
    report.doubtful = sorted(set(report.doubtful) - run.keys())
    return {**run, "recovered_from": report.source.name}


def _description(path: Path) -> dict[str, str] | None:
    file = path / layout.METADATA_FILE
    if not file.is_file():
        return None
    try:
        return run_of_description(read_text(file))
    except (OSError, ValueError):
        return None


def _write(report: RecoveryReport, scans: list[Scan], output: Path) -> None:
    written: Checksums = {}
    with BagWriter(output, metadata=_run(report, scans)) as bag:
        for found in scans:
            _copy(report, found, bag, written)
    if not written:
        raise BagError(f"{report.source}: nothing could be saved, {_why_nothing(report)}")
    read = checksums(output)
    if {topic: sums for topic, sums in read.items() if sums[0]} != written:
        raise BagError(f"{output} did not read back as written; the recovery was discarded")
    report.counts = {topic: count for topic, (count, _) in read.items()}
    with BagReader(output) as reader:
        report.start_ns, report.end_ns = reader.start_ns, reader.end_ns


def _why_nothing(report: RecoveryReport) -> str:
    if report.unproven and not report.unknown:
        return f"no checksum proves any of its {report.unproven} messages"
    return "no topic is known any more"


def _copy(report: RecoveryReport, found: Scan, bag: BagWriter, written: Checksums) -> None:
    topics = {
        key: _topic(found.schemas, channel)
        if found.is_certain(channel) or not found.checked
        else None
        for key, channel in found.channels.items()
    }
    for channel_id, topic in topics.items():
        if topic is None:
            continue
        try:
            bag.add_topic(topic.name, topic.type_name, topic.profiles, text=topic.definition)
        except (BagError, ValueError) as error:
            topics[channel_id] = None
            report.notes.append(f"{topic.name} left out: {error}")
    for message, verified in found.messages():
        topic = topics.get(message.channel_id)
        if found.checked and not verified:
            report.unproven += 1
            continue
        if topic is None:
            report.unknown += 1
            continue
        bag.write_raw(
            topic.name, topic.type_name, message.data, message.log_time, message.publish_time
        )
        _add(written, topic.name, message.log_time, message.data)
        report.unverified += not verified


def _topic(schemas: Mapping[int, Any], channel: Any) -> layout.Topic | None:
    schema = schemas.get(channel.schema_id)
    if schema is None or schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
        return None
    try:
        profiles = parse_qos(channel.metadata.get("offered_qos_profiles", ""))
        text = schema.data.decode()
    except Exception:  # an unsound definition raises nearly anything
        return None
    return layout.Topic(
        name=channel.topic,
        type_name=schema.name,
        profiles=profiles,
        definition=text,
        type_hash="",
    )
