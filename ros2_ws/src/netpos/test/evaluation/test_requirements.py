"""Verdicts on both sides of every limit."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.evaluation.metrics import Figures, Initial
from netpos.evaluation.requirements import Verdict, judge, priority_passage, v2x_sets

GOOD = {
    "output_rate_hz": 5.0,
    "rmse_m": 1.0,
    "heading_rmse_deg": 1.0,
    "speed_max_mps": 42.0,
    "ready": 30.0,
}


def verdict(**changes: float | None) -> Verdict:
    values = GOOD | changes
    ready = values.pop("ready")
    initial = Initial(time_to_first_fix_s=0.0, time_to_ready_s=ready, time_to_1m_s=None)
    return priority_passage(Figures(n=1, initial=initial, **values), np.array([0.5, 2.0]))  # type: ignore[arg-type]


def test_limits_themselves_pass() -> None:
    assert verdict().ok is True


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("output_rate_hz", 4.99),
        ("rmse_m", 1.01),
        ("heading_rmse_deg", 1.01),
        ("speed_max_mps", 42.1),
        ("ready", 30.1),
        ("ready", None),
    ],
)
def test_one_miss_fails_the_set(name: str, value: float | None) -> None:
    assert verdict(**{name: value}).ok is False


@pytest.mark.parametrize("name", ["output_rate_hz", "rmse_m", "heading_rmse_deg"])
def test_what_is_not_known_gives_no_verdict(name: str) -> None:
    assert verdict(**{name: None}).ok is None


def test_the_share_within_1_m_is_shown() -> None:
    assert verdict().rows[-1].measured == 50.0


@pytest.mark.parametrize(
    ("error_m", "expected"),
    [
        (0.5, [True, True, True]),
        (0.6, [True, True, False]),
        (3.1, [True, False, False]),
        (51.0, [False, False, False]),
    ],
)
def test_v2x_sets(error_m: float, expected: list[bool]) -> None:
    assert [v.ok for v in v2x_sets(np.full(100, error_m))] == expected


def test_v2x_set_2_asks_95_percent() -> None:
    """96 of 100 errors within 3 m pass, 90 do not."""
    assert v2x_sets(np.array([2.0] * 96 + [9.0] * 4))[1].ok is True
    assert v2x_sets(np.array([2.0] * 90 + [9.0] * 10))[1].ok is False


def test_without_errors_every_v2x_set_is_open() -> None:
    verdicts = judge(Figures(n=0), np.zeros(0))
    assert [v.ok for v in verdicts[1:]] == [None, None, None]
    assert verdicts[0].ok is False  # it never became ready
