"""Write files completely or not at all; errors name the file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """An ``OSError`` of a write does not name the file: add ``path`` to it."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary file beside ``path`` to write to; it replaces ``path`` at the end.

    A write that fails leaves ``path`` as it was. The suffix is that of ``path``. A path that
    is not a regular file, such as ``/dev/stdout``, is written directly. Missing folders are made.

    Raises
    ------
    OSError  with the name of ``path``
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not path.is_file():
        with naming(path):
            yield path
        return
    target = path.resolve()  # the file that a link leads to
    draft = target.with_name(f".{target.stem}.{os.getpid()}{target.suffix}")
    try:
        with naming(path):
            yield draft
            _settle(draft)
            draft.replace(target)
    except OSError as error:
        if error.filename == str(draft):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        with suppress(FileNotFoundError):
            draft.unlink()


def _settle(draft: Path) -> None:
    """Flush it to the disk: some file systems report a full disk only then."""
    with draft.open("rb") as stream:
        os.fsync(stream.fileno())


def write_text(path: Path, text: str) -> None:
    """Write a text completely or not at all; raises as ``whole_file``."""
    with whole_file(path) as draft:
        draft.write_text(text, encoding="utf-8")
