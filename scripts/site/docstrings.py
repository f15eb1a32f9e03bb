"""Docstrings as mkdocstrings reads them. Ours have `name : meaning` and `Error  when`, the types
are in the signature; the numpydoc parser would take the meaning for a type."""

from __future__ import annotations

import re
from typing import Any

import griffe

_SECTION = re.compile(
    r"^(Parameters|Attributes|Raises)\n-+\n(.*?)(?=^\w.*\n-+\n|\Z)", re.MULTILINE | re.DOTALL
)
_ENTRY = re.compile(r"^(\w+)(?: : |  +)(\S.*)$", re.MULTILINE)


def with_meanings_below(text: str) -> str:
    """A docstring whose entries have their meaning below the name, where numpydoc has it."""

    def below(section: re.Match[str]) -> str:
        head, body = section.group(0).split("\n")[:2], section.group(2)
        return "\n".join([*head, _ENTRY.sub(r"\1\n    \2", body)])

    return _SECTION.sub(below, text)


class MeaningsBelow(griffe.Extension):
    """Changes every docstring before it is parsed."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for every object when it has been loaded."""
        if obj.docstring is not None:
            obj.docstring.value = with_meanings_below(obj.docstring.value)
