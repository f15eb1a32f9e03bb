"""Results of finished jobs in a folder, so that interrupted work goes on where it stopped."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import netpos
from netpos.common.files import whole_file


class Kept:
    """A file for each finished job. A job is another one with other arguments, another version of
    netpos, or a change anywhere in its source.

    The files are pickles: take none from others.
    """

    def __init__(self, folder: Path) -> None:
        """Raises ``NotADirectoryError`` where ``folder`` is a file."""
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(f"{folder} is a file; name a folder for finished parts")
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder

    def through(
        self, submit: Callable[[], Callable[[], Any]], job: Callable[..., Any], *arguments: Any
    ) -> Callable[[], Any]:
        """The result that is there, else that of ``submit``, which is then kept."""
        path = self._folder / f"{_digest(job, arguments)}.part"
        if path.exists():
            return lambda: pickle.loads(path.read_bytes())
        wait = submit()

        def finish() -> Any:
            result = wait()
            with whole_file(path) as unfinished:
                unfinished.write_bytes(pickle.dumps(result))
            return result

        return finish


def _digest(job: Callable[..., Any], arguments: tuple[Any, ...]) -> str:
    description = pickle.dumps((job.__module__, job.__qualname__, arguments))
    return hashlib.sha256(_source() + description).hexdigest()[:32]


@cache
def _source() -> bytes:
    """The library as it is: its version and its text."""
    digest = hashlib.sha256(netpos.__version__.encode())
    root = Path(netpos.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.digest()
