"""A process under measurement: its processor time and memory as the kernel counts them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Self

_STOP_S = 10.0


class Measured:
    """One started process; a context manager that ends it."""

    def __init__(self, command: list[str], log: Path) -> None:
        with log.open("wb") as file:
            self._popen = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT
            )
        self._log, self._name = log, command[0]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._popen.send_signal(signal.SIGINT)
        try:
            self._popen.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()

    def check(self) -> None:
        """Raise ``RuntimeError`` with the end of its output when the process has ended."""
        if self._popen.poll() is not None:
            text = self._log.read_text(encoding="utf-8", errors="replace")[-2000:]
            raise RuntimeError(f"{self._name} ended early:\n{text}")

    def has_said(self, words: str) -> bool:
        """Whether its output holds ``words`` by now."""
        return words in self._log.read_text(encoding="utf-8", errors="replace")

    def cpu_s(self) -> float:
        """Processor time of all its threads so far, user and system."""
        stat = Path(f"/proc/{self._popen.pid}/stat").read_text(encoding="ascii")
        fields = stat.rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def memory_mb(self) -> float:
        """Resident memory [1e6 bytes]."""
        for line in Path(f"/proc/{self._popen.pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) * 1024 / 1e6
        raise RuntimeError("no VmRSS: the process is gone")
