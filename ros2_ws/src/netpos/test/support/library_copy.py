"""A copy of the library to which a page of the documents adds something."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import netpos

DOCS = Path(__file__).resolve().parents[5] / "docs"


def code_of(page: str) -> list[str]:
    """The Python blocks of a page, in order."""
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def copy_of_library(root: Path) -> Path:
    """The package, copied into the folder ``root``."""
    package = root / "netpos"
    here = Path(netpos.__file__).parent
    shutil.copytree(here, package, ignore=shutil.ignore_patterns("__pycache__"))
    return package


def add_entry(room: Path, name: str, module: str, line: str) -> None:
    """Write ``module`` as ``name`` into a room of the estimator and put ``line``, an import and an
    entry, into its table: one line each."""
    (room / f"{name}.py").write_text(module, encoding="utf-8")
    table = room / "table.py"
    before = table.read_text(encoding="utf-8")
    importing, entry = (text.strip() for text in line.split("\n\n"))
    first = re.search(r"^from netpos", before, re.MULTILINE)
    assert first is not None
    after = before[: first.start()] + importing + "\n" + before[first.start() :]
    after = re.sub(
        r"^(\w+: tuple\[\w+, \.\.\.\] = \(\n(?:    .*\n)*)",
        rf"\g<1>    {entry}\n",
        after,
        flags=re.MULTILINE,
    )
    assert len(after.splitlines()) == len(before.splitlines()) + 2
    table.write_text(after, encoding="utf-8")


def run(library: Path, *arguments: str) -> str:
    """Output of Python on the copy in ``library``, without the compiler."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    paths = [str(library), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    command = [sys.executable, "-W", "ignore", *arguments]
    result = subprocess.run(
        command, capture_output=True, text=True, env=environment, check=False, cwd=library
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def run_tests(library: Path, tests: Path, chosen: str) -> int:
    """How many of the ``chosen`` tests of a file pass on the copy; none may fail."""
    root = DOCS.parent
    output = run(
        library,
        "-m",
        "pytest",
        "-q",
        f"--rootdir={root}",
        f"-c={root}/pyproject.toml",
        "-k",
        chosen,
        str(tests),
    )
    return int(re.findall(r"(\d+) passed", output)[0])
