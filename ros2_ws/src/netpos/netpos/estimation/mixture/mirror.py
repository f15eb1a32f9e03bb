"""The mirror image of a device that no measurement tells from the device.

RSUs in one vertical plane that measure distances foresee the same for a device and for its image
behind that plane, and so they do for ever. What is known of the device is then half a mixture, and
half its image. To carry one half is exact and half of the work. Two halves carried side by side
are merged differently, and after some late values one would be refuted by nothing but that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netpos.estimation.measurement import KIND, ORIGIN
from netpos.estimation.mixture.gaussians import Mixture, one_component
from netpos.estimation.mixture.reduction import PART_MERGE_COST, reduced
from netpos.estimation.sensors.table import BY_KIND
from netpos.estimation.state import POSITION, VELOCITY
from netpos.estimation.update.fit import innovations_with_sd
from netpos.messages.values import Array

_LEAST_M = 0.01  # between RSUs that determine a plane
_SAME_SD = 1e-3  # of a value: a million of them tell less than one that is an sd off
_LEAST_VARIANCE = 1e-12  # added: one that is nothing cannot be inverted
_PROBE = np.array([3.7, 5.3])  # along and across the plane: a place like any other [m]


class Mirror(NamedTuple):
    """A vertical plane through ``point`` (2,) m, ``across`` (2,) of unit length square to it."""

    point: Array
    across: Array

    def leaves(self, rows: Array, n: int, height_m: float) -> bool:
        """Whether ``rows`` (m, ROW_WIDTH) are foreseen alike, by a state of ``n`` entries, for a
        device and for its image."""
        here, cov = np.zeros(n), np.zeros((n, n))
        along = np.array([self.across[1], -self.across[0]])
        offset = _PROBE[0] * along + _PROBE[1] * self.across
        here[POSITION], here[VELOCITY] = self.point + offset, offset[::-1]
        there = self.image(one_component(here, cov)).means[0]
        one = innovations_with_sd(here, cov, rows, height_m)
        other = innovations_with_sd(there, cov, rows, height_m)
        return bool((np.abs(one - other)[:, 0] <= _SAME_SD * one[:, 1]).all())

    def image(self, mixture: Mixture) -> Mixture:
        """The mixture on the other side."""
        means, R = mixture.means.copy(), np.eye(mixture.means.shape[1])
        means[:, POSITION] -= self.point
        for block in (POSITION, VELOCITY):
            R[block, block] -= 2.0 * np.outer(self.across, self.across)
        means = means @ R
        means[:, POSITION] += self.point
        return Mixture(means, R @ mixture.covs @ R, mixture.log_weights)

    def both_sides(self, half: Mixture) -> Mixture:
        """The mixture of which one ``half`` is carried."""
        fainter = half._replace(log_weights=half.log_weights - math.log(2.0))
        return Mixture(*map(np.concatenate, zip(fainter, self.image(fainter), strict=True)))

    def one_side(self, mixture: Mixture) -> Mixture:
        """The half to carry of a mixture that is the same on both sides, or of which the other
        side is not known: of each component and its image the one that is nearer to the most
        probable component. What is alike then is merged."""
        image = self.image(mixture)
        best = int(np.argmax(mixture.log_weights))
        nearer = _distance2(mixture, best, image) < _distance2(mixture, best, mixture)
        if not nearer.any():
            return mixture
        means = np.where(nearer[:, None], image.means, mixture.means)
        covs = np.where(nearer[:, None, None], image.covs, mixture.covs)
        half: Mixture = reduced(Mixture(means, covs, mixture.log_weights), PART_MERGE_COST)
        return half


def mirror_of(rows: Array, n: int, height_m: float) -> Mirror | None:
    """The mirror that ``rows`` (m, ROW_WIDTH) leave a state of ``n`` entries, in which position
    and velocity alone have a direction; None where they leave none."""
    of_rsus = [BY_KIND[int(kind)].of_offset is not None for kind in rows[:, KIND]]
    places = rows[of_rsus, ORIGIN : ORIGIN + 2]
    if not len(places):
        return None
    away = places - places[0]
    lengths = np.hypot(away[:, 0], away[:, 1])
    farthest = int(np.argmax(lengths))
    if lengths[farthest] < _LEAST_M:
        return None
    x, y = away[farthest] / lengths[farthest]
    mirror = Mirror(places[0].copy(), np.array([-y, x]))
    return mirror if mirror.leaves(rows, n, height_m) else None


def _distance2(of: Mixture, best: int, to: Mixture) -> Array:
    """Squared Mahalanobis distance (K,) of position and velocity of each component of ``to`` from
    the component ``best``."""
    block = slice(POSITION.start, VELOCITY.stop)
    away = to.means[:, block] - of.means[best, block]
    covs = to.covs[:, block, block] + of.covs[best, block, block] + _LEAST_VARIANCE * np.eye(4)
    solved = np.linalg.solve(covs, away[:, :, None])[:, :, 0]
    return np.asarray((away * solved).sum(axis=1))
