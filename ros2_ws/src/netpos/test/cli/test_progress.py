"""What long work tells, and how it ends when interrupted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from netpos.cli import progress
from netpos.cli.errors import Commands
from netpos.cli.interrupts import answer_ctrl_c
from typer import Exit

# A shell's background jobs, and so their children, ignore SIGINT.
MAIN = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
MAIN += "from netpos.cli.main import main; main()"


def test_a_log_gets_a_sentence_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "SENTENCE_EVERY_S", 0.05)
    with progress.doing("reading") as tell:
        tell(40)
        time.sleep(0.12)
        tell(90)
        time.sleep(0.12)
    told = capsys.readouterr().err.splitlines()
    assert told[0] == "netpos: reading: 0 s, 40 messages"
    assert told[-1].endswith("90 messages")


def test_bars_in_a_log_tell_the_end_of_each(
    capsys: pytest.CaptureFixture[str],
) -> None:
    bars = progress.Bars()
    for done in range(1, 4):
        bars.show("runs", done, 3)
    bars.stop()
    assert capsys.readouterr().err == "netpos: runs: 3 of 3\n"


@pytest.mark.parametrize("kind", [SystemError, RuntimeError])
@pytest.mark.parametrize("caused", [True, False])
def test_an_interrupt_is_one_whatever_python_makes_of_it(
    caused: bool, kind: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A SystemError inside compiled code, a RuntimeError while a class is made; any other is an
    error of the program and stays loud."""

    def invoke(*_: object) -> None:
        error = kind("returned a result with an exception set")
        raise error from (KeyboardInterrupt() if caused else None)

    monkeypatch.setattr(Commands.__mro__[1], "invoke", invoke)
    with pytest.raises(Exit if caused else kind) as raised:
        Commands(name="netpos").invoke(None)
    assert getattr(raised.value, "exit_code", 130) == 130


def test_an_interrupt_waits_for_the_compiler() -> None:
    """Which an exception in its middle would break; it comes right afterwards."""
    text = "def compile(first, then):\n    first()\n    then()\n"
    compiler: dict[str, Any] = {"__name__": "numba.core.compiler"}
    exec(text, compiler)
    finished: list[str] = []

    def stop() -> None:
        os.kill(os.getpid(), signal.SIGINT)

    def finish() -> None:
        time.sleep(0.5)
        finished.append("compiled")

    class Dying:
        def __del__(self) -> None:
            stop()

    def throw_away() -> None:
        """An exception in ``__del__`` is thrown away."""
        Dying()
        time.sleep(5.0)

    hook = sys.unraisablehook
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGALRM)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        answer_ctrl_c()
        with pytest.raises(KeyboardInterrupt):
            _ = [compiler["compile"](stop, finish), time.sleep(5.0)]
        with pytest.raises(KeyboardInterrupt):
            _ = [stop(), time.sleep(5.0)]
        with pytest.raises(KeyboardInterrupt):
            throw_away()
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGINT, before[0])
        signal.signal(signal.SIGALRM, before[1])
    assert finished == ["compiled"]


def test_work_that_counts_is_interrupted_between_two_messages() -> None:
    """Never within one, where compiled code may be called."""
    begun, ended = [], []
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGALRM)
    hook = sys.unraisablehook
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def work() -> None:
        with progress.doing("tracking") as tell:
            for done in range(10):
                tell(done)
                begun.append(done)
                if done == 3:
                    os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.02)
                ended.append(done)

    try:
        answer_ctrl_c()
        with pytest.raises(KeyboardInterrupt):
            work()
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGINT, before[0])
        signal.signal(signal.SIGALRM, before[1])
    assert begun == ended == [0, 1, 2, 3]


def test_where_interrupts_are_ignored_they_stay_so() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        answer_ctrl_c()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("workers", "after_s"), [(1, 2.0), (1, 3.5), (2, 3.5)])
def test_ctrl_c_ends_with_130_and_one_line(workers: int, after_s: float, tmp_path: Path) -> None:
    command = [sys.executable, "-c", MAIN, "reproduce", "fokin2020", "--workers", str(workers)]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    time.sleep(after_s)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in out + err
    assert err.splitlines()[-1] == "netpos: interrupted"
