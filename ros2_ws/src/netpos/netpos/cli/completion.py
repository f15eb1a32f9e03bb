"""What the shell completes besides commands and options."""

from __future__ import annotations


def complete_scenario(incomplete: str) -> list[str]:
    """Scenarios whose names begin so; for others the shell offers files."""
    from netpos.scenario import scenario_names  # noqa: PLC0415 - slow

    return [name for name in scenario_names() if name.startswith(incomplete)]
