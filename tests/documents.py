"""Documents that run: the code blocks of a page, in order, in a folder.

- ``python``: runs in one namespace; what it prints is its output
- ``bash``: runs with ``bash -e``
- any language with ``title="NAME"``: is written to the file NAME
- ``text``: the output of the block before it, with ``...`` for what may differ
- ``console`` and other languages: are only shown
"""

from __future__ import annotations

import io
import re
import subprocess
from collections.abc import Mapping
from contextlib import redirect_stdout
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
        self.ran += 1
        done = subprocess.run(
            ["bash", "-e"],
            input=example.parsed,
            cwd=self._folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=BLOCK_S,
            check=False,
        )
        self._printed = done.stdout
        assert done.returncode == 0, f"{self._path.name}:{example.line}: {done.stdout}"

    def _compare(self, example: Example) -> None:
        self.compared += 1
        found = OutputChecker().check_output(example.parsed, self._printed, _FLAGS)
        assert found, f"{self._path.name}:{example.line}: not as shown: {self._printed}"
