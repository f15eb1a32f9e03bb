"""What the tests start the real processes with leaves nothing behind."""

from __future__ import annotations

from pathlib import Path

from graph import LATCHED, Graph, wait_until
from netpos.bench.domains import claim_domain
from netpos_msgs.msg import RsuInfo


def test_the_next_graph_of_a_domain_does_not_see_the_one_before(tmp_path: Path) -> None:
    """What is left would be found no later than the graph that comes last."""
    with claim_domain() as domain:
        with Graph(domain, tmp_path / "before") as before:
            before.publisher("/before", RsuInfo, LATCHED)
            before.collect("/heard", RsuInfo, LATCHED)
        with Graph(domain, tmp_path / "now") as now, Graph(domain, tmp_path / "other") as other:
            other.publisher("/other", RsuInfo, LATCHED)
            wait_until(lambda: now.node.count_publishers("/other"), "the other graph")
            assert now.node.count_publishers("/before") == 0
            assert now.node.count_subscribers("/heard") == 0
