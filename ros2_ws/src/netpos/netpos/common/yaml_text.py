"""The only way to read and write YAML: fast, plain values only, with limits against hostile
documents.

A few lines with aliases of aliases describe more values than fit into memory, and deep nesting
overflows the stack. Bags and scenarios of others may contain both.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

SIZE_MAX = 16 * 1024**2  # characters; metadata of a bag with a thousand topics has one million
DEPTH_MAX = 60
VALUES_MAX = 1_000_000  # aliases followed
_FAST = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_FAST_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class YamlError(ValueError):
    """Text that is no YAML, or too much; ``line`` counts from 1, None where it is not known."""

    def __init__(self, problem: str, line: int | None = None) -> None:
        where = "" if line is None else f"line {line}: "
        super().__init__(f"{where}{problem}")
        self.problem = problem
        self.line = line


def read_text(file: Path) -> str:
    """The text of a YAML file.

    Raises ``YamlError`` for one that is not a regular file, too large or not UTF-8.
    """
    if not file.is_file():
        raise YamlError(f"{file} is not a regular file")
    size = file.stat().st_size
    if size > 4 * SIZE_MAX:  # bytes of a character in UTF-8
        raise YamlError(f"{size} bytes; at most {SIZE_MAX} characters are read")
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise YamlError(f"not UTF-8 at byte {error.start}") from error


def load_yaml(text: str) -> Any:
    """Plain values of a document.

    Raises ``YamlError`` for a text that is no YAML, holds tags of objects, or exceeds the
    limits of size, depth and number of values.
    """
    check_limits(text)
    try:
        return yaml.load(text, Loader=_FAST)
    except yaml.YAMLError as error:
        raise _yaml_error(error) from error
    except (ValueError, OverflowError) as error:  # a date or a number that there is not
        raise YamlError(f"not valid YAML: {error}") from error


def dump_yaml(value: Any, **style: Any) -> str:
    """The text of plain values; ``style`` as PyYAML's ``dump`` takes it. Raises
    ``yaml.YAMLError`` for other values."""
    return str(yaml.dump(value, Dumper=_FAST_DUMPER, **style))


def compose_yaml(text: str, loader: Any) -> yaml.Node | None:
    """The nodes of a document, with their lines. Raises as ``load_yaml``."""
    check_limits(text)
    try:
        return yaml.compose(text, loader)
    except yaml.YAMLError as error:
        raise _yaml_error(error) from error


def check_limits(text: str) -> None:
    """Raises ``YamlError`` for a document that would take too long, or too much memory, to
    read."""
    if len(text) > SIZE_MAX:
        raise YamlError(f"{len(text)} characters; at most {SIZE_MAX} are read")
    open_values = [0]  # values so far in every collection that is open, aliases followed
    open_anchors: list[str | None] = []
    anchored: dict[str, int] = {}
    try:
        for event in yaml.parse(text, _FAST):
            line = event.start_mark.line + 1
            if isinstance(event, yaml.CollectionStartEvent):
                open_values.append(1)
                open_anchors.append(event.anchor)
                if len(open_anchors) > DEPTH_MAX:
                    raise YamlError(f"nested deeper than {DEPTH_MAX}", line)
            elif isinstance(event, yaml.CollectionEndEvent):
                values, anchor = open_values.pop(), open_anchors.pop()
                open_values[-1] += values
                if anchor is not None:
                    anchored[anchor] = values
            elif isinstance(event, yaml.AliasEvent):
                if event.anchor in open_anchors:
                    raise YamlError(f"*{event.anchor} is a part of itself", line)
                open_values[-1] += anchored.get(event.anchor, 1)
            elif isinstance(event, yaml.ScalarEvent):
                open_values[-1] += 1
            if open_values[-1] > VALUES_MAX:
                raise YamlError(f"more than {VALUES_MAX} values, aliases followed", line)
    except yaml.YAMLError as error:
        raise _yaml_error(error) from error


def _yaml_error(error: yaml.YAMLError) -> YamlError:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or " ".join(str(error).split())
    return YamlError(f"not valid YAML: {problem}", None if mark is None else mark.line + 1)
