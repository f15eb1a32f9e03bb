"""How large the errors of receivers are, by those of their pairs."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Sequence
from typing import TypeVar

Receiver = TypeVar("Receiver", bound=Hashable)


def of_each_receiver(
    errors: Iterable[tuple[Sequence[Receiver], float, float]],
) -> dict[Receiver, tuple[float, float]]:
    """Variance and correlation time [s] of the bias of each receiver, from those of errors that
    are the difference of two receivers, or of one alone: ``(receivers, variance, time_s)``
    (decision 0146).

    Half of the smallest variance of its pairs is put on each receiver. Then the pair counts that
    leaves least to it once the other has had its half: where all pairs of a receiver err much, it
    does itself.
    """
    known = list(errors)
    half: dict[Receiver, float] = {}
    for receivers, variance, _ in known:
        for receiver in receivers:
            half[receiver] = min(0.5 * variance, half.get(receiver, math.inf))
    least: dict[Receiver, tuple[float, float]] = {}
    for receivers, variance, time_s in known:
        for receiver in receivers:
            others = sum(half[other] for other in receivers if other != receiver)
            left = variance - others, time_s
            least[receiver] = min(left, least.get(receiver, left))
    return least
