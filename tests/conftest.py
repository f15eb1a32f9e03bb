"""Fixtures of the integration tests: the running graph, the checkout and the real recordings."""

from __future__ import annotations

import os
import signal
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

os.environ.setdefault(
    "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"
)  # read once, by the first context
# A background job of a shell ignores SIGINT, and so would every process started here.
signal.signal(signal.SIGINT, signal.default_int_handler)

try:
    from graph import Graph
    from netpos.bench.domains import claim_domain
    from netpos_node import choose_profiles
except ImportError as error:
    pytest.exit(f"{error}: run the tests by `make test`, or `source env.sh` first", returncode=4)

choose_profiles(os.environ)  # of the observers; what nodes do is the same

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def repository() -> Path:
    """The checkout under test."""
    return ROOT


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real recordings; the test is skipped where it is absent."""
    folder = Path(os.environ.get("NETPOS_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"real recordings are absent: no folder {folder} (set NETPOS_DATA to it)")
    return folder


@pytest.fixture
def domain_id() -> Iterator[int]:
    """A ROS domain no other test of this machine uses at this time."""
    with claim_domain() as domain:
        yield domain


@pytest.fixture
def graph(domain_id: int, tmp_path: Path) -> Iterator[Graph]:
    """A ROS graph of its own; what is still running at the end is killed."""
    with Graph(domain_id, tmp_path / "logs") as running:
        yield running


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """What the processes of a graph have written is told with the test that failed."""
    report = yield
    running = getattr(item, "funcargs", {}).get("graph")
    if report.when == "call" and report.failed and running is not None:
        report.sections += [(each.name, each.describe()) for each in running.processes]
    return report
