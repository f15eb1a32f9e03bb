"""The compiled choice among the reasons to split, by their place in the table."""

from __future__ import annotations

from netpos.estimation.compile import inlined, kernel, leaf
from netpos.estimation.dispatch import Kernel, choose
from netpos.estimation.engine import EpochInput, FilterOptions
from netpos.estimation.mixture.candidates import Candidates
from netpos.estimation.mixture.gaussians import Mixture
from netpos.estimation.mixture.splits.table import SPLITS
from netpos.estimation.sensors.row import group_end
from netpos.estimation.update.predicted import PredictedRows
from netpos.messages.values import Array

WHOLE = -1
"""In the place of a split: none."""
_COUNT = len(SPLITS)
_MOST = tuple(split.most for split in SPLITS)


@inlined
def _not_divided(_rows: Array, _mean: Array, _cov: Array, _options: FilterOptions) -> bool:
    return False


@inlined
def _none_added(
    _k: int,
    end: int,
    _prior: Mixture,
    _rows: Array,
    _options: FilterOptions,
    _found: Candidates,
) -> int:
    return end


@inlined
def _not_begun(
    _start: int,
    _stop: int,
    _epoch: EpochInput,
    _predicted: PredictedRows,
    _mean: Array,
    _cov: Array,
    _options: FilterOptions,
) -> bool:
    return False


def _chosen(name: str, otherwise: Kernel) -> Kernel:
    return choose([(k, getattr(split, name)) for k, split in enumerate(SPLITS)], otherwise)


_divides = _chosen("divides", _not_divided)
_begins = _chosen("begins", _not_begun)
add_candidates = _chosen("add", _none_added)
"""``(split, k, end, prior, rows, options, found)``"""


@kernel
def split_of(rows: Array, mean: Array, cov: Array, options: FilterOptions) -> int:
    """The split by which the ``rows`` of one measurement divide a component; ``WHOLE``: by
    none."""
    for split in range(_COUNT):
        if _divides(split, rows, mean, cov, options):
            return split
    return WHOLE


@kernel
def most_candidates(split: int) -> int:
    """How many candidates a split makes of a component at most."""
    return int(_MOST[split]) if split != WHOLE else 1


@kernel
def any_divides(components: Mixture, rows: Array, options: FilterOptions) -> bool:
    """Whether a measurement of ``rows`` divides a component."""
    start = 0
    while start < rows.shape[0]:
        stop = group_end(rows, start)
        for k in range(components.log_weights.size):
            mean, cov = components.means[k], components.covs[k]
            if split_of(rows[start:stop], mean, cov, options) != WHOLE:
                return True
        start = stop
    return False


@leaf
def any_begins(
    mean: Array, cov: Array, epoch: EpochInput, predicted: PredictedRows, options: FilterOptions
) -> bool:
    """Whether a measurement of ``epoch`` divides the one component of a track, mean (n,), cov (n,
    n) at the epoch, as it ``predicted`` the rows."""
    start = 0
    while start < epoch.rows.shape[0]:
        stop = group_end(epoch.rows, start)
        for split in range(_COUNT):
            if _begins(split, start, stop, epoch, predicted, mean, cov, options):
                return True
        start = stop
    return False
