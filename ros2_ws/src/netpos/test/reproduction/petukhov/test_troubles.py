"""What goes wrong on the rectangle goes wrong as said, and the tracker gets over it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from netpos.estimation.measurement import ROW_WIDTH, VALUE, VARIANCE
from netpos.evaluation.work import Work
from netpos.messages.values import Array
from netpos.reproduction.petukhov import paper as petukhov
from netpos.reproduction.petukhov import rectangle
from netpos.reproduction.petukhov.rectangle import Case
from netpos.reproduction.petukhov.troubles import NO_TROUBLE, Trouble
from netpos.reproduction.petukhov.walk_figures import Figures

SEED = 7100
TIMES = np.arange(4000) * 0.1


def spoilt(trouble: Trouble) -> Array:
    """Values (n, 2) of ranges of 3 m and phases of 3 rad."""
    radio = np.zeros((len(TIMES), 2, ROW_WIDTH))
    radio[..., VALUE] = 3.0
    radio[..., VARIANCE] = 0.1**2
    trouble.spoil(TIMES, radio, np.random.default_rng(1))
    return np.asarray(radio[..., VALUE])


def test_no_trouble_changes_nothing() -> None:
    assert (spoilt(NO_TROUBLE) == 3.0).all()
    assert NO_TROUBLE.heard(TIMES).all()


def test_reflections_are_any_phase() -> None:
    values = spoilt(Trouble(phase_outliers=0.2))
    wrong = values[values[:, 1] != 3.0, 1]
    assert len(wrong) == pytest.approx(800, abs=80)
    assert np.abs(wrong).max() <= math.pi
    assert wrong.std() == pytest.approx(math.pi / math.sqrt(3.0), rel=0.05)
    assert (values[:, 0] == 3.0).all()


def test_a_blocked_range_is_late_and_a_blocked_phase_noisy() -> None:
    values = spoilt(Trouble(blocked_s=(100.0, 300.0)))
    excess = values[1000:3000, 0] - 3.0
    assert (excess >= 0.0).all()
    assert excess.mean() == pytest.approx(0.3, rel=0.1)
    off = (values[1000:3000, 1] - 3.0 + math.pi) % (2 * math.pi) - math.pi
    assert off.std() == pytest.approx(0.1 * math.sqrt(24.0), rel=0.05)  # on top of its own 0.1
    assert np.abs(values[:, 1]).max() <= math.pi
    assert (np.delete(values, np.s_[1000:3000], axis=0) == 3.0).all()


def test_an_anchor_is_heard_now_and_then() -> None:
    heard = Trouble(heard_every=10).heard(TIMES)
    assert heard.sum() == 400
    assert heard[::10].all()


@pytest.fixture(scope="module")
def troubled() -> dict[Case, Figures]:
    with Work(6, SEED, 1) as work:
        return {case: petukhov.figures_of(work, case) for case in petukhov.TROUBLES}


def test_the_tracker_gets_over_them(troubled: dict[Case, Figures]) -> None:
    reflected, blocked, seldom, poor, wrong = troubled.values()
    assert all(figures.lost == 0 for figures in troubled.values())
    assert reflected.rmse_m < 0.06
    assert blocked.rmse_m < 0.04
    assert seldom.rmse_m < 0.08
    assert poor.rmse_m < 0.03
    assert wrong.error_max_m > 0.5  # it was put there


def test_a_wrong_sector_is_repaired_within_seconds(
    troubled: dict[Case, Figures],
) -> None:
    (case,) = (case for case in troubled if case.trouble.wrong_s is not None)
    times = rectangle.setup_of(case).times_s
    repaired = petukhov._repair_s(np.sqrt(troubled[case].error2), times)
    assert (repaired > 0.3).all()
    assert (repaired < 6.0).all()


def test_repaired_is_small_for_good_and_decided() -> None:
    times = petukhov.WRONG_S + np.arange(6) - 1.0
    small, large, open_ = 0.1, 1.0, np.nan
    error = np.array(
        [
            [large, small, small, small, small, small],
            [small, large, open_, small, small, small],
            [small, large, small, large, small, small],
            [small, large, large, large, large, open_],
        ]
    )
    np.testing.assert_allclose(petukhov._repair_s(error, times), [0.0, 2.0, 3.0, 4.0])
