"""Compare estimates of the same run by paired differences with an interval.

Errors of one run are correlated over seconds, so that epochs are no sample: whole blocks of time
are drawn (circular block bootstrap, Politis and Romano 1992), the same for both sides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netpos.evaluation.evaluate import Evaluation, evaluate_bag
from netpos.evaluation.metrics import SKIP_EPOCHS
from netpos.evaluation.pairing import Stamps
from netpos.messages.values import Array

DRAWS = 2000
CONFIDENCE = 0.95
_BLOCKS_MIN = 5
_SHORTEST_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """One device of two recordings, at the epochs that both have.

    rmse_m : of the first and the second; difference_m : second minus first, with the interval
    that holds it with 95 % probability; only_first, only_second : epochs of one alone; block_s :
    for how long errors are assumed to be correlated
    """

    vue: str
    first: str
    second: str
    epochs: int
    only_first: int
    only_second: int
    rmse_m: tuple[float, float]
    difference_m: float
    interval_m: tuple[float, float]
    block_s: float

    @property
    def told_apart(self) -> bool:
        """Whether the interval leaves out 0."""
        return not self.interval_m[0] <= 0.0 <= self.interval_m[1]

    def sentence(self) -> str:
        """The result in words."""
        low, high = sorted(abs(end) for end in self.interval_m)
        if not self.told_apart:
            low, high = self.interval_m
            return (
                f"{self.vue}: {self.second} and {self.first} are not told apart: "
                f"{self.difference_m:+.3f} m ({low:+.3f} to {high:+.3f})"
            )
        side = "better" if self.difference_m < 0.0 else "worse"
        return (
            f"{self.vue}: {self.second} is {side} than {self.first} by "
            f"{abs(self.difference_m):.3f} m ({low:.3f} to {high:.3f})"
        )

    def to_json(self) -> dict[str, Any]:
        """Plain types."""
        return asdict(self) | {"told_apart": self.told_apart}


def compare_bags(bags: Sequence[Path], *, skip: int = SKIP_EPOCHS) -> list[Difference]:
    """Every bag against the first one, device by device.

    Raises
    ------
    ValueError  fewer than two bags, one that cannot be evaluated, two of one name, or bags that
        have no device or no epoch in common
    """
    if len(bags) < 2:
        raise ValueError(f"compare needs two bags or more, got {len(bags)}")
    names = [bag.name for bag in bags]
    if len(set(names)) < len(names):
        raise ValueError(f"{', '.join(names)}: two bags have the same name; rename one")
    first, *others = [evaluate_bag(bag, skip=skip) for bag in bags]
    differences = [
        _difference(first, other, vue)
        for other in others
        for vue in first.vues
        if vue in other.vues
    ]
    if not differences:
        raise ValueError(f"{names[0]} has no device in common with the others")
    return differences


def _difference(first: Evaluation, second: Evaluation, vue: str) -> Difference:
    errors = []
    for evaluation in (first, second):
        counted = evaluation.vues[vue].scored.counted
        stamps, first_index = np.unique(counted.estimate.stamp_ns, return_index=True)
        errors.append((stamps, counted.horizontal_error[first_index]))
    (a_ns, a), (b_ns, b) = errors
    common, index_a, index_b = np.intersect1d(a_ns, b_ns, return_indices=True)
    if len(common) < _BLOCKS_MIN:
        raise ValueError(
            f"{vue}: {first.path.name} and {second.path.name} have {len(common)} epochs in common;"
            " compare estimates of the same measurements"
        )
    return paired(
        (first.path.name, second.path.name),
        vue,
        common,
        (a[index_a], b[index_b]),
        (len(a) - len(common), len(b) - len(common)),
    )


def paired(
    names: tuple[str, str],
    vue: str,
    stamp_ns: Stamps,
    errors: tuple[Array, Array],
    alone: tuple[int, int] = (0, 0),
) -> Difference:
    """Difference of the RMSE of two error series (n,) m at the same stamps (n,)."""
    a, b = (np.square(error) for error in errors)
    interval_s = float(np.median(np.diff(stamp_ns))) * 1e-9
    length = block_length(b - a, interval_s)
    rng = np.random.default_rng(0)
    n = len(stamp_ns)
    starts = rng.integers(0, n, (DRAWS, math.ceil(n / length)))
    sums = [np.concatenate([[0.0], np.cumsum(np.concatenate([s, s[:length]]))]) for s in (a, b)]
    mean_a, mean_b = ((s[starts + length] - s[starts]).mean(axis=1) / length for s in sums)
    drawn = np.sqrt(np.maximum(mean_b, 0.0)) - np.sqrt(np.maximum(mean_a, 0.0))
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(drawn, [tail, 1.0 - tail]).tolist()
    rmse = float(np.sqrt(a.mean())), float(np.sqrt(b.mean()))
    return Difference(
        vue=vue,
        first=names[0],
        second=names[1],
        epochs=n,
        only_first=alone[0],
        only_second=alone[1],
        rmse_m=rmse,
        difference_m=rmse[1] - rmse[0],
        interval_m=(low, high),
        block_s=length * interval_s,
    )


def block_length(difference: Array, interval_s: float) -> int:
    """Epochs after which the (n,) differences are no longer correlated, a second at least; short
    enough that there are several blocks."""
    n = len(difference)
    centred = difference - difference.mean()
    power = float(centred @ centred)
    least = max(round(_SHORTEST_S / interval_s), 1) if interval_s > 0.0 else 1
    longest = max(n // _BLOCKS_MIN, 1)
    if power > 0.0:
        limit = 2.0 / math.sqrt(n)  # of what white noise shows
        for lag in range(1, longest):
            if float(centred[lag:] @ centred[:-lag]) / power < limit:
                return min(max(2 * lag, least), longest)
    return longest if power > 0.0 else min(least, longest)
