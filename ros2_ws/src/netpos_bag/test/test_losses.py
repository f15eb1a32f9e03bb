"""Messages that never arrived, told by their numbers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from netpos_bag.losses import Losses


def missed(numbers: list[int | None], publishers: int = 1) -> int:
    losses = Losses(lambda: publishers)
    found = [losses.arrived(number) for number in numbers]
    assert losses.count == sum(found)
    return losses.count


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([], 0),
        ([1, 2, 3], 0),
        ([7, 8, 9], 0),  # what was sent before the topic was heard is no loss
        ([1, 2, 5, 6], 2),
        ([1, 3, 5, 7], 3),
        ([None, None], 0),
    ],
)
def test_gaps_of_one_publisher(numbers: list[int | None], lost: int) -> None:
    assert missed(numbers) == lost


def test_a_publisher_that_starts_anew_has_lost_nothing() -> None:
    assert missed([41, 42, 43, 1, 2, 3, 5]) == 1


@pytest.mark.parametrize("seed", range(20))
def test_several_publishers_of_one_topic_lose_what_they_lost(seed: int) -> None:
    """Three publishers far apart in their numbers, each heard once and then in a random order:
    every gap counts."""
    rng = np.random.default_rng(seed)
    streams, lost = [], 0
    for start in (1, 10_000, 20_000):
        kept = [start + i for i in range(300) if i == 0 or rng.random() > 0.1]
        lost += sum(b - a - 1 for a, b in itertools.pairwise(kept))
        streams.append(kept)
    rest = rng.permutation(np.repeat(np.arange(3), [len(kept) - 1 for kept in streams]))
    pending = [iter(kept) for kept in streams]
    assert missed([next(pending[i]) for i in (0, 1, 2, *rest)], publishers=3) == lost
