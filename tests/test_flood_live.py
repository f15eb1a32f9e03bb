"""20,000 messages a second from one sender: the others are answered, it is counted and named.

How late the answers are is a row of ``netpos bench --only flood``.
"""

from __future__ import annotations

from netpos.bench.live import probe

RATE_HZ, SECONDS = 20_000, 4


def test_a_flood_costs_no_answer_and_is_counted() -> None:
    figures = probe("flood", "--rate", str(RATE_HZ), "--seconds", str(SECONDS))
    assert figures["odometry"] == figures["epochs"] == 10 * 10 * SECONDS
    # What of a flood is lost on its way says nothing of the tracker.
    assert figures["refused_of_flood"] > 0.1 * RATE_HZ * SECONDS
