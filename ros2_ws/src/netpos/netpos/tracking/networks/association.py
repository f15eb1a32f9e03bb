"""Which tracks of different networks are the same device.

The difference of two tracks of one device is Gaussian with the sum of their covariances (an upper
bound where they share motion noise). Its squared Mahalanobis distance and -2 ln of its density are
averaged over time with a fading memory: devices that meet look alike for an instant, not for a
minute. A pair is fused once the best assignment of all tracks beats the best one without it by a
margin, and is given up only where another assignment is better by the same margin, so that
crossing devices keep their tracks.

References: Kosaka, Meng and Kak 1993 (track-to-track association with memory); Bar-Shalom and Li
1995, ch. 8 (the test and the assignment).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from netpos.estimation.chi_square import chi_square_bound
from netpos.messages.values import Array
from netpos.tracking.networks.common_instant import Moved
from netpos.tracking.networks.config import FusionConfig

Slots = NDArray[np.int64]
Mask = NDArray[np.bool_]

_DOF = 6
_FORBIDDEN = 1e9
_FIRST_LOOK_S = 0.1  # what a pair's first comparison counts for


class PairScores:
    """Misfit of every pair of tracks, remembered. Tracks are numbered slots."""

    def __init__(self, config: FusionConfig) -> None:
        self._memory_s = config.memory_s
        self._gate = chi_square_bound(_DOF, 1.0 - config.gate_probability)
        self._weight: Array = np.zeros((0, 0))  # remembered time [s]
        self._distance: Array = np.zeros((0, 0))  # times the mean squared distance
        self._cost: Array = np.zeros((0, 0))  # times the mean -2 ln likelihood
        self._watched: Array = np.zeros((0, 0))  # time compared [s]
        self._last_ns = 0
        self._free: list[int] = []

    def take_slot(self) -> int:
        """A number for a new track."""
        if self._free:
            return self._free.pop()
        n = len(self._weight)
        for name in ("_weight", "_distance", "_cost", "_watched"):
            setattr(self, name, np.pad(getattr(self, name), (0, 1)))
        return n

    def forget(self, slot: int) -> None:
        """Forget what is known of a track."""
        for table in (self._weight, self._distance, self._cost, self._watched):
            table[slot, :] = table[:, slot] = 0.0

    def free_slot(self, slot: int) -> None:
        """A track has ended: its number may be given to another."""
        self.forget(slot)
        self._free.append(slot)

    def look(self, stamp_ns: int, slots: Slots, moved: Moved, network: Slots) -> None:
        """Compare all tracks (k,) of different networks (k,) at one instant."""
        elapsed_s = (stamp_ns - self._last_ns) * 1e-9 if self._last_ns else 0.0
        self._last_ns = stamp_ns
        a, b = np.nonzero(network[:, None] < network[None, :])
        if not a.size:
            return
        difference = moved.mean[a] - moved.mean[b]
        S = moved.cov[a] + moved.cov[b]
        distance = np.einsum(
            "ki,ki->k", difference, np.linalg.solve(S, difference[..., None])[..., 0]
        )
        cost = distance + np.linalg.slogdet(S)[1]
        i, j = slots[a], slots[b]
        i, j = np.minimum(i, j), np.maximum(i, j)
        fade = np.exp(-elapsed_s / self._memory_s)
        weight = np.where(self._weight[i, j] > 0.0, elapsed_s, _FIRST_LOOK_S)
        self._watched[i, j] += np.where(self._weight[i, j] > 0.0, elapsed_s, 0.0)
        self._weight[i, j] = fade * self._weight[i, j] + weight
        self._distance[i, j] = fade * self._distance[i, j] + weight * distance
        self._cost[i, j] = fade * self._cost[i, j] + weight * cost

    def _mean(self, table: Array, rows: Slots, columns: Slots) -> Array:
        i, j = np.minimum(rows, columns), np.maximum(rows, columns)
        mean: Array = table[i, j] / self._weight[i, j]
        return mean

    def costs(self, groups: Sequence[Sequence[int]], slots: Slots) -> tuple[Array, Mask]:
        """(g, k) mean -2 ln likelihood of each track with the tracks of each group, and whether
        all these pairs pass the gate. What fails it costs what the gate just allows."""
        cost = np.empty((len(groups), slots.size))
        passes = np.empty(cost.shape, dtype=np.bool_)
        for g, group in enumerate(groups):
            members = np.array(group)[:, None]
            distance = self._mean(self._distance, members, slots[None, :])
            excess = np.maximum(distance - self._gate, 0.0)
            pair = self._mean(self._cost, members, slots[None, :]) - excess
            cost[g], passes[g] = pair.mean(axis=0), (excess == 0.0).all(axis=0)
        return cost, passes

    def watched_s(self, a: int, b: int) -> float:
        """How long two tracks have been compared."""
        return float(self._watched[min(a, b), max(a, b)])


class Association:
    """Groups of tracks, one per device, kept from epoch to epoch."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self.scores = PairScores(config)
        self._partners: dict[int, set[int]] = {}

    def end(self, slot: int) -> None:
        """A track has ended."""
        self.forget(slot)
        self.scores.free_slot(slot)

    def forget(self, slot: int) -> None:
        """A track follows another device now."""
        self.scores.forget(slot)
        for partner in self._partners.pop(slot, set()):
            self._partners[partner].discard(slot)

    def groups(self, slots: Slots, network: Slots) -> tuple[list[list[int]], set[int]]:
        """Groups of slots, each with at most one track of each network, from tracks (k,) of
        networks (k,) numbered in order of preference; and the tracks that fit a group, but not
        clearly: they are groups of their own for now."""
        groups: list[list[int]] = []
        open_: set[int] = set()
        for number in np.unique(network):
            newcomers = slots[network == number]
            joined, unclear = self._assign(groups, newcomers)
            open_ |= unclear
            for slot in newcomers.tolist():
                if slot in joined:
                    groups[joined[slot]].append(slot)
                else:
                    groups.append([slot])
        self._note(groups)
        return groups, open_

    def _assign(self, groups: list[list[int]], slots: Slots) -> tuple[dict[int, int], set[int]]:
        """Index of the group each track clearly belongs to, and the tracks where it is unclear."""
        if not groups:
            return {}, set()
        plain, passes = self.scores.costs(groups, slots)
        known = np.array([[self._are_partners(g, s) for s in slots.tolist()] for g in groups])
        cost = np.where(known, plain - self._config.decision_margin, plain)
        rows, columns = linear_sum_assignment(cost)
        joined: dict[int, int] = {}
        unclear: set[int] = set()
        for row, column in zip(rows, columns, strict=True):
            slot = int(slots[column])
            if not passes[row, column]:
                continue
            clear = known[row, column] or self._is_clear(plain, row, column)
            watched_s = min(self.scores.watched_s(slot, member) for member in groups[row])
            if clear and watched_s >= self._config.confirm_s:
                joined[slot] = int(row)
            else:
                unclear.add(slot)
        return joined, unclear

    def _is_clear(self, cost: Array, row: int, column: int) -> bool:
        """Whether the best assignment with a pair fits better than the best one without."""
        without = cost.copy()
        without[row, column] = _FORBIDDEN
        best, other = (table[linear_sum_assignment(table)].sum() for table in (cost, without))
        return bool(other - best >= self._config.decision_margin)

    def _are_partners(self, group: Sequence[int], slot: int) -> bool:
        return all(slot in self._partners.get(member, ()) for member in group)

    def _note(self, groups: Sequence[Sequence[int]]) -> None:
        """Remember who belongs together; a track that is silent now keeps its partners."""
        present = {slot for group in groups for slot in group}
        for group in groups:
            for slot in group:
                silent = {p for p in self._partners.get(slot, set()) if p not in present}
                self._partners[slot] = silent | (set(group) - {slot})
        for slot, partners in self._partners.items():
            if slot not in present:
                self._partners[slot] = {p for p in partners if slot in self._partners.get(p, ())}


def by_name(slots: Slots, names: Sequence[str]) -> list[list[int]]:
    """Groups of the tracks (k,) that have the same name (k,), in the order given."""
    groups: dict[str, list[int]] = {}
    for slot, name in zip(slots.tolist(), names, strict=True):
        groups.setdefault(name, []).append(slot)
    return list(groups.values())
