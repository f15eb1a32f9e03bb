"""Ctrl-C that compiled code survives."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130
"""Exit status, as shells have it."""
_COMPILER = ("numba", "llvmlite")
_PATIENCE_S = 0.3


class _CtrlC:
    """A request to stop by Ctrl-C.

    An exception that comes while compiled code is called, or the compiler works, may end in a
    ``SystemError`` or a segmentation fault. So work that counts its messages calls ``check`` after
    each; other work is interrupted after ``_PATIENCE_S``, outside of the compiler. A second Ctrl-C
    ends the process at once.
    """

    wanted = False

    def check(self) -> None:
        """Raise ``KeyboardInterrupt`` if Ctrl-C was pressed."""
        if self.wanted:
            self.wanted = False
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            raise KeyboardInterrupt

    def ask(self, *_: object) -> None:
        """Handle SIGINT."""
        if self.wanted:
            sys.stderr.write("netpos: interrupted\n")
            leave()
        self.wanted = True
        self.later()

    def later(self) -> None:
        """Interrupt in a moment, unless ``check`` does so before."""
        signal.setitimer(signal.ITIMER_REAL, _PATIENCE_S)

    def insist(self, _: int, frame: FrameType | None) -> None:
        """Handle SIGALRM: ``check`` was not called in time."""
        if _is_in_compiler(frame):
            self.later()
        else:
            self.check()

    def thrown_away(self, error: sys.UnraisableHookArgs) -> None:
        """Keep a Ctrl-C that came in ``__del__`` or around a fork, where Python ignores it."""
        if issubclass(error.exc_type, KeyboardInterrupt):
            self.wanted = True
            self.later()
        else:
            sys.__unraisablehook__(error)


CTRL_C = _CtrlC()


def answer_ctrl_c() -> None:
    """Handle SIGINT as ``_CtrlC`` describes. Where it is ignored, as in background jobs of a
    shell, it stays ignored."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    sys.unraisablehook = CTRL_C.thrown_away
    signal.signal(signal.SIGALRM, CTRL_C.insist)
    signal.signal(signal.SIGINT, CTRL_C.ask)


def leave() -> None:
    """End the process without waiting for its threads, which may wait for ever."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(INTERRUPTED)


def _is_in_compiler(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in _COMPILER:
            return True
        frame = frame.f_back
    return False
