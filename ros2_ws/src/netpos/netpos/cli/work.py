"""Options of commands that run many jobs, and the message when a worker dies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from netpos.cli.errors import WorkFailedError

Workers = Annotated[int | None, typer.Option(help="Processes. Default: one per processor.")]
ClusterAddress = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="ADDRESS",
        help="Run on a Ray cluster: HOST:PORT, ray://HOST:10001, auto, or local for a new one "
        "on this machine.",
    ),
]
Resume = Annotated[
    Path | None,
    typer.Option(
        "--resume",
        metavar="FOLDER",
        help="Keep finished parts in this folder; parts found there are not run again.",
    ),
]


@contextmanager
def worked() -> Iterator[None]:
    """If a worker dies the work has failed; the message says what to do."""
    from netpos.evaluation.work import WorkerDiedError  # noqa: PLC0415

    try:
        yield
    except WorkerDiedError as error:
        raise WorkFailedError(
            f"{error}; try fewer --workers; with --resume finished parts are kept"
        ) from error
