"""Names of a package that are imported when they are first used."""

from __future__ import annotations

import subprocess
import sys

import netpos.bags
import netpos.scenario
import pytest


@pytest.mark.parametrize("package", [netpos.bags, netpos.scenario])
def test_every_name_is_there_and_no_other(package: object) -> None:
    for name in package.__all__:  # type: ignore[attr-defined]
        assert getattr(package, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'math'"):
        package.math  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize(
    ("used", "absent"),
    [
        ("from netpos.bags import codec", "netpos.bags.reader"),
        ("from netpos.scenario import Scenario", "netpos.scenario.simulation"),
    ],
)
def test_who_uses_one_name_does_not_load_the_others(used: str, absent: str) -> None:
    code = f"import sys; {used}; print({absent!r} in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
