"""Parameters as fields of a dataclass: ranges, words and sentences in their metadata, from which
nodes describe them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import field, fields
from difflib import get_close_matches
from typing import Any, TypeVar

Config = TypeVar("Config")

_LEAST = 1e-9


class FaultsError(ValueError):
    """One or several errors, one line each."""


def real(default: float, low: float, high: float, text: str) -> Any:
    """A number of a configuration, with its range and a sentence."""
    return field(default=default, metadata={"low": low, "high": high, "text": text})


def positive(default: float, text: str) -> Any:
    """A number above 0 without an upper limit."""
    return real(default, _LEAST, 1.0 / _LEAST, text)


def not_negative(default: float, text: str) -> Any:
    """A number >= 0 without an upper limit."""
    return real(default, 0.0, 1.0 / _LEAST, text)


def count(default: int, text: str) -> Any:
    """A whole number from 1 on."""
    return field(default=default, metadata={"low": 1, "high": 10000, "text": text})


def described(default: bool | str | tuple[float, ...], text: str) -> Any:
    """A switch, a name, or as many finite numbers as the default has."""
    return field(default=default, metadata={"text": text})


def choice(default: str, choices: tuple[str, ...], text: str) -> Any:
    """A word of a configuration, with the words allowed and a sentence."""
    return field(default=default, metadata={"choices": choices, "text": text})


def described_fields(config: type[Any]) -> list[tuple[str, str, str]]:
    """Name, range or choices, and meaning of each parameter of a configuration; no choices where
    the meaning names them."""
    described = []
    for entry in fields(config):
        about = entry.metadata
        if "choices" in about:
            named = all(choice in about["text"] for choice in about["choices"])
            limits = "" if named else "one of " + ", ".join(about["choices"])
        elif "low" in about:
            limits = f"{about['low']:g} to {about['high']:g}"
        elif isinstance(entry.default, bool):
            limits = "true or false"
        else:
            limits = "text" if isinstance(entry.default, str) else "numbers"
        described.append((entry.name, limits, about["text"]))
    return described


def check_fields(config: Any, prefix: str = "") -> None:
    """Raises ``ValueError`` naming, after ``prefix``, the first field out of its range or
    words."""
    for entry in fields(config):
        name, value = prefix + entry.name, getattr(config, entry.name)
        choices = entry.metadata.get("choices")
        if choices is not None and value not in choices:
            raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
        if "low" in entry.metadata:
            low, high = entry.metadata["low"], entry.metadata["high"]
            if not (math.isfinite(value) and low <= value <= high):
                raise ValueError(f"{name} must be in [{low:g}, {high:g}], got {value!r}")
        if isinstance(entry.default, tuple):
            size = len(entry.default)
            if len(value) != size or not all(map(math.isfinite, value)):
                raise ValueError(f"{name} must be {size} finite numbers, got {value}")


def nearest(name: str, known: Iterable[str]) -> str:
    """``; did you mean NAME?``, or nothing where none is near."""
    close = get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""


def from_mapping(config: type[Config], values: Mapping[str, Any], what: str) -> Config:
    """A configuration of named values over its defaults; raises ``ValueError``, with a line for
    each name that does not exist and the nearest one that does."""
    known = [entry.name for entry in fields(config)]  # type: ignore[arg-type]
    unknown = [name for name in values if name not in known]
    if unknown:
        messages = [f"unknown {what} parameter {name!r}{nearest(name, known)}" for name in unknown]
        raise FaultsError("\n".join(messages))
    plain = config()
    return config(**{name: typed(name, getattr(plain, name), v) for name, v in values.items()})


def typed(name: str, default: Any, value: Any) -> Any:
    """``value`` in the type of the default; YAML writes 1 for 1.0 and 1e-4 for a string.

    Raises ``ValueError`` naming the parameter.
    """
    if isinstance(default, bool):
        if isinstance(value, bool):
            return value
        if str(value).lower() in {"true", "false"}:
            return str(value).lower() == "true"
        raise ValueError(f"{name} must be true or false, got {value!r}")
    kind = type(default)
    try:
        if isinstance(value, bool) or (kind is tuple and isinstance(value, str)):
            raise ValueError(value)
        if kind is tuple:
            return tuple(typed(name, 0.0, number) for number in value)
        converted = kind(value)
        if kind is int and converted != float(value):
            raise ValueError(value)
        return converted
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be of type {kind.__name__}, got {value!r}") from None
