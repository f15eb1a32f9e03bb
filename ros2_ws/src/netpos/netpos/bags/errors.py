"""Errors of bags and recordings."""

from __future__ import annotations

from pathlib import Path


class BagError(ValueError):
    """A bag or a recording cannot be used; the sentence names the file and the remedy."""


def require_file(file: Path) -> None:
    """BagError for a pipe, a device or a folder: reading it may never end."""
    if not file.is_file():
        raise BagError(f"{file} is not a regular file; give the path of a recording on a disk")
