"""The bound of a filter that knows the instants, against the information of a batch."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.estimation.measurement import VARIANCE, predict_row
from netpos.reproduction.petukhov import paper as petukhov
from netpos.reproduction.petukhov.rectangle import ERRORS, setup_of
from netpos.reproduction.petukhov.steps import velocity_rows
from netpos.reproduction.petukhov.walk_bound import known_instants_rmse_m


def test_the_last_bound_is_that_of_one_great_least_squares() -> None:
    """Unknown: where the walk begins and one velocity per stretch of constant motion."""
    setup = setup_of(petukhov.LONG)
    velocity, step = velocity_rows(
        setup.times_s, setup.steps, ERRORS, np.random.default_rng(1), 0.0
    )
    rows = np.concatenate([setup.rows(1)[:, :2], velocity], axis=1)
    edges = [0.0, 1.02, 6.72, 7.74, 12.24, 13.26, 18.96, 19.98, 24.48, 25.6]  # legs and pauses
    information = np.zeros((2 + 2 * (len(edges) - 1),) * 2)
    information[:2, :2] = np.eye(2) / 100.0
    for i in range(len(edges) - 1):
        free = 1.5**2 if i == 0 else 10.0**2
        first = 2 + 2 * i
        information[first : first + 2, first : first + 2] += np.eye(2) / free
    h = np.zeros(6)
    for k, time in enumerate(setup.times_s.tolist()):
        walked = np.clip(time - np.array(edges[:-1]), 0.0, np.diff(edges))
        leg = int(np.searchsorted(edges, time, side="right")) - 1
        map_ = np.zeros((4, len(information)))
        map_[:2, :2] = np.eye(2)
        for i, seconds in enumerate(walked.tolist()):
            map_[:2, 2 + 2 * i : 4 + 2 * i] = seconds * np.eye(2)
        map_[2:, 2 + 2 * leg : 4 + 2 * leg] = np.eye(2)
        truth = np.array([*setup.truth[k], 0.0, 0.0, 0.0, 0.0])
        for i, row in enumerate(rows[k]):
            if i > 1 and step[k] >= 0 and k > 0 and step[k - 1] == step[k]:
                continue
            predict_row(row, truth, setup.config.device_height_m, h)
            gradient = h[:4] @ map_
            information += np.outer(gradient, gradient) / row[VARIANCE]
    cov = map_[:2] @ np.linalg.inv(information) @ map_[:2].T
    bound_m = known_instants_rmse_m(setup, float(setup.times_s[-1]))
    assert bound_m == pytest.approx(np.sqrt(np.trace(cov)), rel=0.01)


def test_who_may_change_at_every_step_is_known_less() -> None:
    setup = setup_of(petukhov.LONG)
    kept, free = (known_instants_rmse_m(setup, 1.3, every) for every in (False, True))
    assert 1.2 * kept < free < 0.03
