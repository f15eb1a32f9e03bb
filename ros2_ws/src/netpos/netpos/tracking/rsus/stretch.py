"""By which share all distances are too long: ranges of one make have it in common, by their clock,
the medium or a calibration, everywhere and for ever.

Two hypotheses run beside each other, each with error models of its own: that there is none, and
that there is one, which is taken out. The share is that of weighted least squares over what a
shift of the device leaves of the residuals of each window; how well each hypothesis says the next
window beforehand decides between the two (prequential likelihoods: Dawid 1984). Errors that RSUs
share, or that follow the distance by chance, are in neither: the likelihood ratio therefore counts
for a tenth (a coarsened posterior: Miller and Dunson 2019), and what slow errors of the RSUs may
pretend must be exceeded, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce

import numpy as np

from netpos.messages.values import Array

_PRIOR_LOG_ODDS = math.log(0.05 / 0.95)
_PRIOR_INFORMATION = 0.05**-2
_COUNTS = 0.1  # of a log-likelihood ratio
_CERTAIN_SD = 3.0
_MEMORY = 100.0  # windows
_TAIL = 5.0  # degrees of freedom of the errors of windows


@dataclass(frozen=True, slots=True)
class Stretch:
    """What windows say of it. All but ``log_odds`` fades."""

    information: float = 0.0
    """On the share (1)."""
    weighted: float = 0.0
    """That times the share."""
    independent: float = 0.0
    """Information that is left if slow errors are the same from window to window."""
    log_odds: float = 0.0
    """By how much the hypothesis that there is one has foreseen the windows better."""

    def __add__(self, other: Stretch) -> Stretch:
        return Stretch(
            self.information + other.information,
            self.weighted + other.weighted,
            self.independent + other.independent,
            self.log_odds + other.log_odds,
        )

    @property
    def share(self) -> float:
        """By which share distances are too long if they are (1)."""
        return self.weighted / (_PRIOR_INFORMATION + self.information)

    @property
    def sd(self) -> float:
        """Of that (1)."""
        return 1.0 / math.sqrt(_PRIOR_INFORMATION + self.independent)

    def is_one(self, believed: bool) -> bool:
        """Whether there is one rather than none. What is not ``believed`` so far must exceed what
        slow errors may pretend, too."""
        likelier = _PRIOR_LOG_ODDS + _COUNTS * self.log_odds > 0.0
        return likelier and (believed or abs(self.share) > _CERTAIN_SD * self.sd)

    def seen(
        self, left: Array, distance: Array, independent: Array, share: float, log_odds: float
    ) -> Stretch:
        """With a window more of m distances, after which the hypothesis is likelier by
        ``log_odds``.

        left, distance : (m,) what is left of residuals after ``share`` (1) was taken out, and of
            the distances, both over the sd of the residual
        independent : (m,) part of each variance that is not the same from window to window
        """
        weight = np.minimum((_TAIL + 1.0) / (_TAIL + left**2), 1.0)
        new = weight * distance**2
        old, information = 1.0 - 1.0 / _MEMORY, float(new.sum())
        return Stretch(
            old * self.information + information,
            old * self.weighted + float(weight @ (distance * left)) + share * information,
            old * self.independent + float(independent @ new),
            log_odds,
        )


NONE_SEEN = Stretch()


def together(own: Stretch, others: Iterable[Stretch]) -> Stretch:
    """What a device and others have seen."""
    return reduce(Stretch.__add__, others, own)
