"""What the tests start the real processes with leaves nothing behind."""

from __future__ import annotations

from pathlib import Path

import pytest
from graph import LATCHED, Graph, wait_until
from netpos.bench.domains import claim_domain
from netpos_msgs.msg import RsuInfo

FOUND_S = 4.0  # a node that is left is found within a second or two


def test_the_next_graph_of_a_domain_does_not_see_the_one_before(tmp_path: Path) -> None:
    with claim_domain() as domain:
        with Graph(domain, tmp_path / "before") as before:
            before.publisher("/before", RsuInfo, LATCHED)
            before.collect("/heard", RsuInfo, LATCHED)
            wait_until(lambda: before.node.count_subscribers("/heard"), "its own")
        with Graph(domain, tmp_path / "now") as now, pytest.raises(TimeoutError):
            wait_until(
                lambda: (
                    now.node.count_publishers("/before") + now.node.count_subscribers("/heard")
                ),
                "what was left",
                FOUND_S,
            )
