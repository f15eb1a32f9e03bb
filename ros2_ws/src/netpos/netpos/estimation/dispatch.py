"""Compiled choice among the entries of a table by their number: sensors, motion models, filter
forms.

One function per choice, ``if kind == number: return model(...)`` for each entry, written out and
spliced into its callers before they are compiled. So a choice is not compiled by itself, which
would compile all its entries once more, and is cached with its callers.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from netpos.estimation.compile import link, spliced

Kernel = Callable[..., Any]

Numbered = tuple[int, Kernel | None]


def choose(models: Sequence[Numbered], otherwise: Kernel) -> Kernel:
    """Function ``(kind, *args)`` that calls the model with the number ``kind``, else
    ``otherwise``, with the arguments ``*args``.

    models : number and function of each entry; an entry whose function is None is left out. All
        functions, ``otherwise`` too, take as many arguments and return the same type.
    """
    numbers: dict[int, list[int]] = {}
    names: dict[str, Any] = {"otherwise": otherwise}
    for number, model in models:
        if model is not None:
            numbers.setdefault(id(model), []).append(number)
            names[f"model_{id(model)}"] = model
    count = len(inspect.signature(getattr(otherwise, "py_func", otherwise)).parameters)
    given = ", ".join(f"a{k}" for k in range(count))
    lines = [f"def chosen(kind, {given}):"]
    for identity, its in numbers.items():
        asked = " or ".join(f"kind == {number}" for number in its)
        lines += [f"    if {asked}:", f"        return model_{identity}({given})"]
    lines.append(f"    return otherwise({given})")
    exec("\n".join(lines), names)
    chosen: Kernel = spliced(names["chosen"])
    return chosen


def is_one_of(kinds: Iterable[int]) -> Kernel:
    """Function ``(kind) -> bool``: whether ``kind`` is one of ``kinds``, each 0 to 62."""
    bits = sum(1 << kind for kind in set(kinds))

    @link
    def is_member(kind: int) -> bool:
        return (bits >> kind) & 1 == 1

    return is_member  # type: ignore[no-any-return]
