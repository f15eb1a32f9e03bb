"""20,000 messages a second from one sender: the others are answered in time, and it is counted."""

from __future__ import annotations

from netpos.bench.live import probe

RATE_HZ, SECONDS = 20_000, 4
BEHIND_S = 0.1


def test_a_flood_delays_nobody() -> None:
    figures = probe("flood", "--rate", str(RATE_HZ), "--seconds", str(SECONDS))
    assert figures["odometry"] == figures["epochs"] == 10 * 10 * SECONDS
    assert figures["lag_p99_s"] < BEHIND_S
    # What of a flood is lost on its way says nothing of the tracker.
    assert figures["refused_of_flood"] > 0.1 * RATE_HZ * SECONDS
