"""The completion that ``netpos --show-completion bash`` prints, run by bash."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

# As bash calls it when TAB is pressed after these words.
PRESS_TAB = """
eval "$(netpos --show-completion bash)"
complete -p netpos
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
"$(complete -p netpos | sed 's/.*-F \\([^ ]*\\) .*/\\1/')" netpos
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module", name="command")
def _command(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the command ``netpos`` of this source tree."""
    folder = tmp_path_factory.mktemp("bin")
    file = folder / "netpos"
    code = "import sys; from netpos.cli.main import main; sys.exit(main())"
    file.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{code}' \"$@\"\n", encoding="utf-8")
    file.chmod(0o755)
    return folder


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["netpos", "ev"], ["evaluate"]),
        (["netpos", "re"], ["replay", "report", "reproduce", "recover"]),
        (["netpos", "evaluate", "--err"], ["--errors"]),
        (["netpos", "replay", "--set", "a=1", "--sm"], ["--smooth"]),
        (["netpos", "import", "cs"], ["csv"]),
        (["netpos", "run", "fast"], ["fast_pass", "fast_pass_100hz"]),
        (["netpos", "sweep", "tdoa"], ["tdoa_yard"]),
        (["netpos", "evaluate", "my"], []),
    ],
)
def test_tab(
    words: list[str], offered: list[str], command: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where nothing is offered, bash offers files: ``-o default``."""
    monkeypatch.setenv("PATH", str(command), prepend=":")
    done = subprocess.run(
        ["bash", "-c", PRESS_TAB, "bash", *words], capture_output=True, text=True, check=True
    )
    registered, *found = done.stdout.split("\n")
    assert registered.startswith("complete -o default ")
    assert sorted(filter(None, found)) == sorted(offered)
    assert done.stderr == ""
