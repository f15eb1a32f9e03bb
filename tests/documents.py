"""Documents that run: the code blocks of a page, in order, in a folder.

- ``python``: runs in one namespace; what it prints is its output
- ``bash``: runs with ``bash -e``
- any language with ``title="NAME"``: is written to the file NAME
- ``text``: the output of the block before it, with ``...`` for what may differ
- ``sh`` and other languages: are only shown
"""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from contextlib import redirect_stdout, suppress
from doctest import ELLIPSIS, NORMALIZE_WHITESPACE, OutputChecker
from pathlib import Path
from typing import Any

from sybil import Document, Example
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.markdown.lexers import RawFencedCodeBlockLexer

_INFO = re.compile(r'(?P<language>\w+)[ \t]*(?:title="(?P<title>[^"]+)")?[ \t]*\n')
_FLAGS = ELLIPSIS | NORMALIZE_WHITESPACE
BLOCK_S = 240.0


class Page:
    """Runs one document; ``outputs`` counts those that were compared."""

    def __init__(self, path: Path, folder: Path, environment: Mapping[str, str]) -> None:
        self._path, self._folder, self._environment = path, folder, dict(environment)
        self._printed = ""
        self.ran = self.compared = 0

    def run(self) -> None:
        """Run all blocks; ``AssertionError`` names the line of the first that fails."""
        for example in Document.parse(str(self._path), self._regions).examples():
            example.evaluate()

    def _regions(self, document: Document) -> Any:
        for region in RawFencedCodeBlockLexer(_INFO)(document):
            region.parsed = region.lexemes["source"]
            region.evaluator = self._evaluate
            yield region

    def _evaluate(self, example: Example) -> None:
        lexemes = example.region.lexemes
        language, title = lexemes["language"], lexemes["title"]
        if title:
            (self._folder / title).write_text(example.parsed, encoding="utf-8")
        elif language == "python":
            self._python(example)
        elif language == "bash":
            self._bash(example)
        elif language == "text":
            self._compare(example)

    def _python(self, example: Example) -> None:
        self.ran += 1
        printed = io.StringIO()
        with redirect_stdout(printed):
            PythonEvaluator()(example)
        self._printed = printed.getvalue()

    def _bash(self, example: Example) -> None:
        """What a failed block has started in the background is ended with it."""
        self.ran += 1
        with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
            bash = subprocess.Popen(
                ["bash", "-ec", example.parsed],
                cwd=self._folder,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                process_group=0,
            )
            try:
                bash.wait(BLOCK_S)
            except subprocess.TimeoutExpired:
                pass  # it has no return code then
            finally:
                if bash.poll() != 0:
                    with suppress(ProcessLookupError):
                        os.killpg(bash.pid, signal.SIGTERM)
            output.seek(0)
            self._printed = output.read()
        assert bash.returncode == 0, f"{self._path.name}:{example.line}: {self._printed}"

    def _compare(self, example: Example) -> None:
        self.compared += 1
        found = OutputChecker().check_output(example.parsed, self._printed, _FLAGS)
        assert found, f"{self._path.name}:{example.line}: not as shown: {self._printed}"
