"""Compiled choice among the entries of a table by their number: sensors, motion models, filter
forms.

A chain of inlined closures, one per entry: ``if kind == number: return model(...)``, else the
rest of the chain. The compiler makes of it what it makes of the same ``if`` statements written
one after the other. The closures are compiled as parts of their callers and cached with them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from netpos.estimation.compile import link

Kernel = Callable[..., Any]

Numbered = tuple[int, Kernel | None]


def choose(models: Sequence[Numbered], otherwise: Kernel) -> Kernel:
    """Function ``(kind, *args)`` that calls the model with the number ``kind``, else
    ``otherwise``, with the arguments ``*args``.

    models : number and function of each entry; an entry whose function is None is left out. All
        functions, ``otherwise`` too, return the same type.
    """
    chain = _last(otherwise)
    for number, model in reversed(models):
        if model is not None:
            chain = _before(number, model, chain)
    return chain


def is_one_of(kinds: Iterable[int]) -> Kernel:
    """Function ``(kind) -> bool``: whether ``kind`` is one of ``kinds``, each 0 to 62."""
    bits = sum(1 << kind for kind in set(kinds))

    @link
    def is_member(kind: int) -> bool:
        return (bits >> kind) & 1 == 1

    return is_member  # type: ignore[no-any-return]


def _last(otherwise: Kernel) -> Kernel:
    @link
    def last(_kind, *args):  # type: ignore[no-untyped-def]
        return otherwise(*args)

    return last  # type: ignore[no-any-return]


def _before(number: int, model: Kernel, rest: Kernel) -> Kernel:
    @link
    def chosen(kind, *args):  # type: ignore[no-untyped-def]
        if kind == number:
            return model(*args)
        return rest(kind, *args)

    return chosen  # type: ignore[no-any-return]
