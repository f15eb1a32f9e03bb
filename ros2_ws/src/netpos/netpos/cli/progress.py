"""Progress on stderr: a moving line on a terminal, a sentence every ten seconds in a log or a
pipe."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from netpos.cli.interrupts import CTRL_C

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

SENTENCE_EVERY_S = 10.0
_SHOWN_EVERY_S = 0.1

Counted = Callable[[int], None]
"""Called with the number of parts done; raises ``KeyboardInterrupt`` after Ctrl-C."""


@contextmanager
def doing(text: str, of: str = "messages") -> Iterator[Counted]:
    """Show the progress of work whose end is not known; ``of``: what is counted."""
    from rich.console import Console  # noqa: PLC0415

    console = Console(stderr=True)
    if not console.is_terminal:
        with _sentences(text, of) as tell:
            yield tell
        return
    due_s = 0.0
    with console.status(text) as status:

        def show(done: int) -> None:
            nonlocal due_s
            CTRL_C.check()
            now_s = time.monotonic()
            if now_s > due_s:
                due_s = now_s + _SHOWN_EVERY_S
                status.update(f"{text}: {done} {of}")

        yield show


@contextmanager
def _sentences(text: str, of: str) -> Iterator[Counted]:
    """A sentence every ``SENTENCE_EVERY_S``, even if the work does not report."""
    count, over, start_s = [0], threading.Event(), time.monotonic()

    def tell() -> None:
        while not over.wait(SENTENCE_EVERY_S):
            counted = f", {count[0]} {of}" if count[0] else ""
            typer.echo(f"netpos: {text}: {time.monotonic() - start_s:.0f} s{counted}", err=True)

    def counted_to(done: int) -> None:
        CTRL_C.check()
        count[0] = done

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield counted_to
    finally:
        over.set()
        teller.join()


class Bars:
    """Work whose end is known, a bar for each label. The first begins with the first report: its
    thread must not exist when worker processes are forked."""

    def __init__(self) -> None:
        from rich.console import Console  # noqa: PLC0415

        self._console = Console(stderr=True)
        self._told_s = time.monotonic()
        self._progress: Progress | None = None
        self._tasks: dict[str, TaskID] = {}

    def show(self, label: str, done: int, total: int) -> None:
        """Report of ``work.Progress``."""
        if not self._console.is_terminal:
            if done == total or time.monotonic() - self._told_s > SENTENCE_EVERY_S:
                self._told_s = time.monotonic()
                typer.echo(f"netpos: {label}: {done} of {total}", err=True)
            return
        if self._progress is None:
            from rich.progress import Progress, TimeElapsedColumn  # noqa: PLC0415

            columns = (*Progress.get_default_columns(), TimeElapsedColumn())
            self._progress = Progress(*columns, console=self._console)
            self._progress.start()
        if label not in self._tasks:
            self._tasks[label] = self._progress.add_task(label, total=total)
        self._progress.update(self._tasks[label], completed=done)

    def stop(self) -> None:
        """Leave the bars as they are."""
        if self._progress is not None:
            self._progress.stop()
