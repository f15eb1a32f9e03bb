"""What a reason to split a component is: the record that a module of this folder fills in."""

from __future__ import annotations

from dataclasses import dataclass

from netpos.estimation.dispatch import Kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class Split:
    """A reason to make several candidates of a component and one measurement.

    divides : ``(rows, mean, cov, options) -> bool``: whether the rows (m, ROW_WIDTH) of one
        measurement divide the component mean (n,), cov (n, n)
    add : ``(k, end, prior, rows, options, found) -> end``: fuses them into the candidates it makes
        of the component ``k`` of the mixture ``prior``, written to ``found`` (``Candidates``) from
        ``end`` on; the number of candidates then
    most : how many these are at most
    begins : ``(start, stop, epoch, predicted, mean, cov, options) -> bool``: whether a track of
        one component is divided by the measurement in the rows ``start`` to ``stop`` of
        ``epoch``, an ``EpochInput``, seen from mean (n,), cov (n, n) as ``predicted``. It may ask
        for more than ``divides``: for every epoch it is part of what the one component costs.
    """

    divides: Kernel
    add: Kernel
    most: int
    begins: Kernel
