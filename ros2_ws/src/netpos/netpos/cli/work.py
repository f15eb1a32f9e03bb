"""Options of commands that run many jobs, and how their failures are told."""

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
        help="Keep finished parts there; those that are there already are not run again.",
    ),
]


@contextmanager
def worked() -> Iterator[None]:
    """Failed work where a worker has died, in words that say what to do."""
    from netpos.evaluation.work import WorkerDiedError  # noqa: PLC0415

    try:
        yield
    except WorkerDiedError as error:
        raise WorkFailedError(
            f"{error}; try fewer --workers; with --resume what is finished is kept"
        ) from error
