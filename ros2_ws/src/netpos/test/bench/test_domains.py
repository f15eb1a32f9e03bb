"""ROS domains, each for one user at a time."""

from __future__ import annotations

from netpos.bench.domains import DOMAINS, claim_domain


def test_a_domain_is_used_again_as_late_as_possible() -> None:
    """Drawn blindly, two of thirty would be the same in 99 of 100 runs."""
    found = []
    for _ in range(30):
        with claim_domain() as domain, claim_domain() as other:
            found += [domain, other]
            assert {domain, other} <= set(DOMAINS)
    assert len(set(found)) == len(found)
