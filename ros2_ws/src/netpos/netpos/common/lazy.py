"""Names of a package that are imported when they are first used."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def imported_when_used(package: str, *modules: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a ``package`` whose ``__all__`` names what is in these ``modules``:
    the first that has a name is where it comes from, and those behind it are not loaded."""

    def attribute(name: str) -> Any:
        if name in sys.modules[package].__all__:
            for module in modules:
                found = vars(import_module(f"{package}.{module}"))
                if name in found:
                    return found[name]
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return attribute
