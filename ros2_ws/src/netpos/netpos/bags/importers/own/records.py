"""One line of a text file or one message: values by name, and where they stand."""

from __future__ import annotations

import csv
import gzip
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, Protocol

from rosbags.highlevel import AnyReader

from netpos.bags.errors import BagError, require_file
from netpos.bags.layout import METADATA_FILE
from netpos.common.parameters import nearest
from netpos.common.yaml_text import YamlError, check_limits, read_text

DELIMITERS = {"comma": ",", "tab": "\t", "semicolon": ";", "blank": " "}
EMPTY = {"", "nan", "none", "null", "na", "-"}


class Record(Protocol):
    """What a line or a message offers."""

    @property
    def where(self) -> str:
        """File and line, or topic and number of the message."""

    def value(self, source: str) -> Any:
        """The value of a column or field; BagError where there is none of that name."""


def problem(record: Record, text: str) -> BagError:
    """An error that says where it is."""
    return BagError(f"{record.where}: {text}")


def number(record: Record, source: str, name: str) -> float | None:
    """A finite number, or None where the value is empty or not a number by intention (NaN).

    Raises ``BagError`` for other text and for infinity.
    """
    value = record.value(source)
    text = str(value).strip()
    if text.lower() in EMPTY:
        return None
    try:
        result = float(value if not isinstance(value, str) else text)
    except (TypeError, ValueError):
        raise problem(record, f"{name} {text!r} in {source} is not a number") from None
    if math.isnan(result):
        return None
    if math.isinf(result):
        raise problem(record, f"{name} in {source} is {text}, not finite")
    return result


def label(record: Record, source: str) -> str:
    """A name; a whole number written as 5.0 or 5e0 is 5."""
    text = str(record.value(source)).strip()
    try:
        exact = Decimal(text)
    except InvalidOperation:
        return text
    return str(int(exact)) if exact.is_finite() and exact == int(exact) else text


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a text file; columns by the name in the header or by number from 1."""

    file: Path
    number: int
    values: Sequence[str]
    header: Mapping[str, int]

    @property
    def where(self) -> str:
        """File and line."""
        return f"{self.file}, line {self.number}"

    def value(self, source: str) -> str:
        """Text of a column."""
        column = self.header.get(source)
        if column is None:
            column = int(source) - 1 if source.isdecimal() else -1
        if not 0 <= column < len(self.values):
            raise problem(self, f"no column {source} among {len(self.values)}")
        return self.values[column]


def lines(
    file: Path, sources: Sequence[str], delimiter: str | None
) -> Iterator[tuple[Line, bool]]:
    """Every line with values and whether it may be cut (the first or the last of the file).

    The delimiter is found in the first line where none is given. A header is there where a source
    is a name, or where the first line holds no number.

    Raises
    ------
    BagError  no such file, not text, empty, or a source that is no column
    """
    rows = _rows(file, delimiter)
    first = next(rows, None)
    if first is None:
        raise BagError(f"{file} is empty; give a file with one line a measurement")
    header = _header(file, first[1], sources)
    waiting = next(rows, None) if header else first
    start = waiting
    while waiting is not None:
        following = next(rows, None)
        edge = following is None or waiting is start
        yield Line(file, *waiting, header), edge
        waiting = following


def _rows(file: Path, delimiter: str | None) -> Iterator[tuple[int, Sequence[str]]]:
    if not file.is_file():
        raise BagError(f"{file} does not exist or is no file; give a text file")
    opened = gzip.open if file.suffix == ".gz" else open
    try:
        with opened(file, "rt", encoding="utf-8-sig", newline="") as stream:
            for number, text in enumerate(stream, start=1):
                plain = text.strip("\r\n")
                if not plain.strip() or plain.lstrip().startswith("#"):
                    continue
                delimiter = delimiter or _delimiter(plain)
                yield number, _fields(plain, delimiter)
    except (UnicodeDecodeError, csv.Error, gzip.BadGzipFile, EOFError) as error:
        raise BagError(
            f"{file} is not a text file ({error}); give CSV, TSV or .gz of one"
        ) from None


def _delimiter(text: str) -> str:
    return next((sign for sign in ("\t", ";", ",") if sign in text), " ")


def _fields(text: str, delimiter: str) -> Sequence[str]:
    if delimiter == " ":
        return text.split()
    return [value.strip() for value in next(csv.reader([text], delimiter=delimiter))]


def _header(file: Path, values: Sequence[str], sources: Sequence[str]) -> dict[str, int]:
    names = [source for source in sources if not source.isdecimal()]
    if not names and any(_is_number(value) for value in values):
        return {}
    header = {value.lstrip("%").strip(): column for column, value in enumerate(values)}
    for name in names:
        if name not in header:
            raise BagError(
                f"{file} has no column {name!r}{nearest(name, list(header))}; its header is: "
                f"{', '.join(header)}"
            )
    return header


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@dataclass(frozen=True, slots=True)
class Message:
    """A message of a bag; fields by their path, such as ``header.stamp``."""

    topic: str
    number: int
    content: Any
    time_ns: int

    @property
    def where(self) -> str:
        """Topic and number of the message."""
        return f"{self.topic}, message {self.number}"

    def value(self, source: str) -> Any:
        """Value of a field; ``recorded`` is when the recorder got the message [ns]."""
        if source == "recorded":
            return self.time_ns
        found = self.content
        for part in source.split("."):
            name, bracket, index = part.partition("[")
            known = getattr(found, "__dataclass_fields__", {})
            if name not in known:
                names = [key for key in known if not key.startswith("__")]
                raise problem(
                    self,
                    f"no field {source!r}{nearest(name, names)}; there "
                    f"{'is' if len(names) == 1 else 'are'} {', '.join(names) or 'none below it'}",
                )
            found = getattr(found, name)
            if bracket:
                found = _element(self, source, found, index)
        return found


def _element(message: Message, source: str, found: Any, index: str) -> Any:
    try:
        return found[int(index.rstrip("]"))]
    except (TypeError, ValueError, IndexError):
        raise problem(message, f"no element {source!r}") from None


def messages(bag: Path, topic: str) -> Iterator[Message]:
    """The messages of one topic of a ROS 1 or ROS 2 bag.

    Raises
    ------
    BagError  no such bag or topic, or its type is not in the bag
    """
    if not bag.exists():
        raise BagError(f"{bag} does not exist; give a .bag, .mcap or .db3 file or a bag's folder")
    if not bag.is_dir():
        require_file(bag)
    elif (bag / METADATA_FILE).exists():
        try:
            check_limits(read_text(bag / METADATA_FILE))
        except YamlError as error:
            raise BagError(f"{bag}/{METADATA_FILE} cannot be read: {error}") from error
    try:
        with AnyReader([bag]) as reader:
            chosen = [c for c in reader.connections if c.topic == topic]
            if not chosen:
                names = sorted(reader.topics)
                raise BagError(
                    f"{bag} has no topic {topic}{nearest(topic, names)}; it has {', '.join(names)}"
                )
            found = reader.messages(connections=chosen)
            for count, (connection, time_ns, raw) in enumerate(found, start=1):
                content = reader.deserialize(raw, connection.msgtype)
                yield Message(topic, count, content, time_ns)
    except BagError:
        raise
    except Exception as error:  # damaged bytes raise nearly anything
        raise BagError(f"{bag} cannot be read as a ROS bag: {error!r}") from error


class Skipped(Counter[str]):
    """How many values or lines were left out, by reason."""
