"""Pairs of tracks: the averaged misfit by hand, the gate at its edge, crossing, unclear pairs."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.messages.values import Array
from netpos.tracking.networks.association import Association, PairScores, by_name
from netpos.tracking.networks.common_instant import Moved
from netpos.tracking.networks.config import FusionConfig
from scipy.stats import chi2

S = 1_000_000_000
NETWORK = np.array([0, 0, 1, 1])
SLOTS = np.arange(4)


def moved(x: list[float], var: float = 1.0) -> Moved:
    """Tracks at (x, 0) that are otherwise alike."""
    n = len(x)
    mean = np.zeros((n, 6))
    mean[:, 0] = x
    cov = np.tile(var * np.eye(6), (n, 1, 1))
    return Moved(mean, cov, np.zeros_like(cov))


def association(**values: float) -> Association:
    config = FusionConfig(**{"confirm_s": 0.0, "decision_margin": 4.0, **values})  # type: ignore[arg-type]
    made = Association(config)
    for _ in range(4):
        made.scores.take_slot()
    return made


def look(made: Association, t_s: float, x: list[float], slots: Array = SLOTS) -> list[list[int]]:
    made.scores.look(S + round(t_s * S), slots, moved(x), NETWORK[: len(x)])
    return made.groups(slots, NETWORK[: len(x)])[0]


def test_mean_misfit_by_hand() -> None:
    """Two looks a second apart: first weight 0.1 s, then 1 s, the first one faded."""
    scores = PairScores(FusionConfig(memory_s=2.0, gate_probability=1.0))
    slots, network = np.array([scores.take_slot(), scores.take_slot()]), np.array([0, 1])
    scores.look(S, slots, moved([0.0, 2.0]), network)
    scores.look(2 * S, slots, moved([0.0, 6.0]), network)
    fade = np.exp(-1.0 / 2.0)
    distances = np.array([4.0, 36.0]) / 2.0  # S = 2 I
    weights = np.array([0.1 * fade, 1.0])
    cost, passes = scores.costs([[0]], np.array([1]))
    expected = weights @ distances / weights.sum() + 6.0 * np.log(2.0)
    assert cost[0, 0] == pytest.approx(expected, rel=1e-12)
    assert passes.all()
    assert scores.watched_s(1, 0) == pytest.approx(1.0)


@pytest.mark.parametrize(("factor", "together"), [(0.999, True), (1.001, False)])
def test_gate_at_its_edge(factor: float, together: bool) -> None:
    made = association(gate_probability=0.99)
    limit = np.sqrt(2.0 * chi2.ppf(0.99, 6))
    made.scores.look(S, np.array([0, 2]), moved([0.0, factor * limit]), np.array([0, 1]))
    groups, unclear = made.groups(np.array([0, 2]), np.array([0, 1]))
    assert groups == ([[0, 2]] if together else [[0], [2]])
    assert unclear == set()


def test_beyond_the_gate_costs_what_the_gate_allows() -> None:
    scores = PairScores(FusionConfig(gate_probability=0.99))
    slots, network = np.array([scores.take_slot(), scores.take_slot()]), np.array([0, 1])
    scores.look(S, slots, moved([0.0, 1000.0]), network)
    cost, passes = scores.costs([[0]], np.array([1]))
    assert cost[0, 0] == pytest.approx(chi2.ppf(0.99, 6) + 6.0 * np.log(2.0), rel=1e-9)
    assert not passes.any()


def test_the_nearest_pairs_are_found_whatever_the_order() -> None:
    assert look(association(), 0.0, [0.0, 20.0, 20.5, 0.5]) == [[0, 3], [1, 2]]


def test_an_assignment_is_jointly_best_not_greedy() -> None:
    """Track 2 is nearest to 1, but only together with the other pair does all fit: 0-2, 1-3."""
    made = association(decision_margin=0.0, gate_probability=0.9999999)
    assert look(made, 0.0, [0.0, 4.0, 2.5, 6.5]) == [[0, 2], [1, 3]]


def test_pairs_that_fit_alike_stay_apart_for_now() -> None:
    made = association()
    made.scores.look(S, SLOTS, moved([0.0, 0.4, 0.2, 0.3]), NETWORK)
    groups, unclear = made.groups(SLOTS, NETWORK)
    assert groups == [[0], [1], [2], [3]]
    assert unclear == {2, 3}


def test_a_pair_is_watched_before_it_is_fused() -> None:
    made = association(confirm_s=1.0)
    assert look(made, 0.0, [0.0, 50.0, 0.1, 50.1]) == [[0], [1], [2], [3]]
    assert look(made, 0.9, [0.0, 50.0, 0.1, 50.1]) == [[0], [1], [2], [3]]
    assert look(made, 1.1, [0.0, 50.0, 0.1, 50.1]) == [[0, 2], [1, 3]]


def test_crossing_objects_keep_their_tracks() -> None:
    """They meet at 10 s and look swapped there by a metre; what was seen before counts."""
    made, forgetful = association(), association(memory_s=0.1, decision_margin=0.0)
    seen: list[list[list[int]]] = []
    for t in np.arange(0.0, 20.0, 0.5):
        a, b = t - 10.0, 10.0 - t
        swap = 1.0 if 9.0 < t < 11.0 else 0.0
        x = [a, b, a + swap * (b - a) + 0.1, b + swap * (a - b) - 0.1]
        assert look(made, t, x) == [[0, 2], [1, 3]]
        seen.append(look(forgetful, t, x))
    assert [[0, 3], [1, 2]] in seen


def test_a_wrong_pair_is_given_up_once_the_rival_is_clearly_better() -> None:
    made = association(gate_probability=1.0)
    assert look(made, 0.0, [0.0, 8.0, 1.0, 9.0]) == [[0, 2], [1, 3]]
    after = [look(made, t, [0.0, 8.0, 8.0, 0.0]) for t in np.arange(0.5, 3.0, 0.5)]
    assert after[-1] == [[0, 3], [1, 2]]


def test_a_pair_that_stands_is_kept_against_a_rival_within_the_margin() -> None:
    """A whole swap has to be better by twice the margin, one for each pair it ends."""
    for excess, kept in ((1.9, True), (2.1, False)):
        made = association(gate_probability=1.0, memory_s=0.1, decision_margin=4.0)
        assert look(made, 0.0, [0.0, 10.0, 0.0, 10.0]) == [[0, 2], [1, 3]]
        # swapped costs 0, as it stands 2 * gap^2 / 2 = gap^2: equal to 4 * excess
        gap = 2.0 * np.sqrt(excess)
        now = look(made, 10.0, [0.0, gap, gap, 0.0])
        assert now == ([[0, 2], [1, 3]] if kept else [[0, 3], [1, 2]])


def test_forgotten_tracks_leave_no_trace() -> None:
    made = association()
    look(made, 0.0, [0.0, 50.0, 0.1, 50.1])
    made.end(2)
    assert made.scores.take_slot() == 2
    assert made.scores.watched_s(0, 2) == 0.0
    assert look(made, 1.0, [0.0, 50.0, 50.1, 0.1]) == [[0], [1, 3], [2]] or look(
        made, 30.0, [0.0, 50.0, 50.1, 0.1]
    ) == [[0, 3], [1, 2]]


def test_names() -> None:
    groups = by_name(np.array([4, 5, 6]), ["a", "b", "a"])
    assert groups == [[4, 6], [5]]
