"""Positions of tables in a page: between ``<!-- table: RECORDED NAME -->`` and
``<!-- end of table -->``."""

from __future__ import annotations

import re
from collections.abc import Callable

_BEGIN = re.compile(r"<!-- table: (\S+) (\S[^\n]*?) -->\n")
_END = "<!-- end of table -->"


class PageError(ValueError):
    """A page that cannot be rendered; the text says where and why."""


def fill(text: str, table: Callable[[str, str], str]) -> str:
    """The page with ``table(recorded, name)`` between its markers; every table ends with a
    newline.

    Raises
    ------
    PageError  a table has no end, or an end no table
    """
    parts, position = [], 0
    while begin := _BEGIN.search(text, position):
        end = text.find(_END, begin.end())
        following = _BEGIN.search(text, begin.end())
        if end < 0 or (following is not None and following.start() < end):
            raise PageError(f"table {begin[1]} {begin[2]} lacks its line {_END}")
        if _END in text[position : begin.start()]:
            raise PageError(f"a line {_END} before table {begin[1]} {begin[2]} ends no table")
        parts += [text[position : begin.end()], "\n", table(begin[1], begin[2]), "\n", _END]
        position = end + len(_END)
    rest = text[position:]
    if _END in rest or "<!-- table" in rest:
        raise PageError(
            f"a marker after the last table is not one of a table: {rest.strip()[:80]}"
        )
    return "".join([*parts, rest])
