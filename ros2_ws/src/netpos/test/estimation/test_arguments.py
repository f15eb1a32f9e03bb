"""Functions take few enough arguments to be read at the place that calls them."""

from __future__ import annotations

import ast
from pathlib import Path

import netpos
import pytest

MOST = 8
ROOT = Path(netpos.__file__).parent
MODULES = sorted(path for room in ("filters", "tracking") for path in (ROOT / room).rglob("*.py"))


def parameters(function: ast.FunctionDef) -> list[str]:
    """Names without ``self`` and ``cls``; ``*args`` and ``**kwargs`` count as one each."""
    args = function.args
    several = [a for a in (args.vararg, args.kwarg) if a is not None]
    names = [a.arg for a in (*args.posonlyargs, *args.args, *args.kwonlyargs, *several)]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def crowded(source: str) -> set[str]:
    functions = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef))
    return {function.name for function in functions if len(parameters(function)) > MOST}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_function_takes_more_than_eight_arguments(path: Path) -> None:
    assert not crowded(path.read_text())


@pytest.mark.parametrize(
    ("head", "too_many"),
    [
        ("a, b, c, d, e, f, g, h", False),
        ("a, b, c, d, e, f, g, h, i", True),
        ("self, a, b, c, d, e, f, g, h", False),
        ("a, b, c, d, *, e, f, g, h, i", True),
        ("a, b, c, d, e, f, g, h, *more", True),
    ],
)
def test_what_counts_as_an_argument(head: str, too_many: bool) -> None:
    assert bool(crowded(f"def f({head}): ...")) is too_many
