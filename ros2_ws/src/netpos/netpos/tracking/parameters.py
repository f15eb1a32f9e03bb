"""Parameters as fields of a dataclass: ranges, words and sentences in their metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, fields
from typing import Any, TypeVar

Config = TypeVar("Config")


def real(default: float, low: float, high: float, text: str) -> Any:
    """A number of a configuration, with its range and a sentence."""
    return field(default=default, metadata={"low": low, "high": high, "text": text})


def choice(default: str, choices: tuple[str, ...], text: str) -> Any:
    """A word of a configuration, with the words allowed and a sentence."""
    return field(default=default, metadata={"choices": choices, "text": text})


def check_fields(config: Any) -> None:
    """Raises ``ValueError`` naming the first field out of its range or words."""
    for entry in fields(config):
        value = getattr(config, entry.name)
        choices = entry.metadata.get("choices")
        if choices is not None and value not in choices:
            raise ValueError(f"{entry.name} must be one of {', '.join(choices)}, got {value!r}")
        if "low" in entry.metadata:
            low, high = entry.metadata["low"], entry.metadata["high"]
            if not (math.isfinite(value) and low <= value <= high):
                raise ValueError(f"{entry.name} must be in [{low:g}, {high:g}], got {value!r}")


def from_mapping(config: type[Config], values: Mapping[str, Any], what: str) -> Config:
    """A configuration of named values over its defaults; raises ``ValueError`` for a name that
    does not exist."""
    known = {entry.name for entry in fields(config)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - known)
    if unknown:
        names = ", ".join(entry.name for entry in fields(config))  # type: ignore[arg-type]
        raise ValueError(f"unknown {what} parameter {unknown[0]!r}; the parameters are {names}")
    plain = config()
    return config(**{name: _typed(name, getattr(plain, name), v) for name, v in values.items()})


def _typed(name: str, default: Any, value: Any) -> Any:
    """``value`` in the type of the default; YAML writes 1 for 1.0 and 1e-4 for a string."""
    if isinstance(default, bool):
        if isinstance(value, bool):
            return value
        if str(value).lower() in {"true", "false"}:
            return str(value).lower() == "true"
        raise ValueError(f"{name} must be true or false, got {value!r}")
    try:
        typed = type(default)(value)
        if isinstance(default, int) and typed != float(value):
            raise ValueError(value)
        return typed
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must be of type {type(default).__name__}, got {value!r}"
        ) from None
