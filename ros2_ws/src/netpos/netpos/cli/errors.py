"""How errors reach the user of the command line."""

from __future__ import annotations

import errno
from typing import Any

import typer
from typer.core import TyperGroup

from netpos.cli.interrupts import INTERRUPTED
from netpos.common.parameters import FaultsError

_BAD_INPUT = (
    ValueError,
    FileExistsError,
    FileNotFoundError,
    IsADirectoryError,
    NotADirectoryError,
    PermissionError,
)


_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class WorkFailedError(RuntimeError):
    """The input was fine and the work was not done: exit status 1."""


def _sentences(error: BaseException) -> list[str]:
    """One sentence, or one for each of several faults."""
    if isinstance(error, OSError) and error.filename is not None:
        remedy = "; make room there and run it again" if error.errno in _FULL else ""
        return [f"{error.filename}: {error.strerror}{remedy}"]
    if isinstance(error, FaultsError):
        return str(error).splitlines()
    return [" ".join(str(error).split()) or type(error).__name__]


def _tell(error: BaseException) -> None:
    for sentence in _sentences(error):
        typer.echo(f"netpos: {sentence}", err=True)


def _is_interrupt(error: BaseException) -> bool:
    """Ctrl-C, also one that Python reports as another error because of it: a ``SystemError`` where
    compiled code was called, a ``RuntimeError`` where a class was made."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause is not None


class Commands(TyperGroup):
    """Turns errors of bad input and failed work into one sentence and an exit status; errors of
    the program itself keep their traceback.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except (typer.Exit, BrokenPipeError):  # the reader has gone, as in `netpos ... | head`
            raise
        except (KeyboardInterrupt, Exception) as error:
            if _is_interrupt(error):
                typer.echo("netpos: interrupted", err=True)
                raise typer.Exit(INTERRUPTED) from None
            if isinstance(error, _BAD_INPUT):
                _tell(error)
                raise typer.Exit(2) from error
            if isinstance(error, (WorkFailedError, OSError)):
                _tell(error)
                raise typer.Exit(1) from error
            raise
