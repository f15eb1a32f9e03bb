"""The reasons to split a component. The first that divides a measurement makes its candidates."""

from __future__ import annotations

from netpos.estimation.mixture.splits.paths import SPLIT as PATHS
from netpos.estimation.mixture.splits.ring import SPLIT as RING
from netpos.estimation.mixture.splits.split import Split

SPLITS: tuple[Split, ...] = (
    RING,
    PATHS,
)
