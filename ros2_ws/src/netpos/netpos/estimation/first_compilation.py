"""Says that kernels are compiled, the first time they are."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from numba.core import event

SENTENCE = (
    "netpos: compiling kernels for this machine; once, some seconds for each kind of tracker\n"
)


class _Once(event.Listener):  # type: ignore[misc]
    """Tells of the first compilation and no other."""

    def on_start(self, _: event.Event) -> None:
        event.unregister(event_kind, self)
        sys.stderr.write(SENTENCE)
        sys.stderr.flush()

    def on_end(self, _: event.Event) -> None:
        """Nothing is told."""


event_kind = "numba:compile"


def tell_first_compilation() -> None:
    """Have the first compilation told on stderr, where no kernel has been compiled before."""
    folder = os.environ.get("NUMBA_CACHE_DIR", "")
    if folder and not any(Path(folder).rglob("*.nbi")):
        event.register(event_kind, _Once())
