"""Ellipses against the chi-square law, circles, and the numbers of shapes from frame to frame."""

from __future__ import annotations

import numpy as np
import pytest
from netpos.live.scene import ELLIPSE_SCALE
from netpos.live.shapes import Kind, Numbers, Shape, circle, ellipse_axes
from scipy.stats import chi2


def shape(group: str, name: str) -> Shape:
    return Shape(
        group=group, name=name, kind=Kind.DISC, colour=(1.0, 0.0, 0.0, 1.0), size=(1.0, 1.0, 0.1)
    )


def test_points_of_the_ellipse_have_the_probability_it_is_named_after() -> None:
    cov = np.array([[4.0, 1.5], [1.5, 1.0]])
    major, minor, angle = ellipse_axes(cov, ELLIPSE_SCALE)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for t in np.linspace(0.0, 2.0 * np.pi, 17):
        point = turn @ np.array([major * np.cos(t), minor * np.sin(t)])
        distance = point @ np.linalg.solve(cov, point)
        assert distance == pytest.approx(chi2.ppf(0.95, 2), rel=1e-9)
    assert major > minor > 0.0


def test_a_covariance_without_width_is_a_line() -> None:
    major, minor, angle = ellipse_axes(np.array([[1.0, 1.0], [1.0, 1.0]]), 1.0)
    assert (major, minor) == pytest.approx((np.sqrt(2.0), 0.0), abs=1e-7)
    assert np.tan(angle) == pytest.approx(1.0)


def test_a_circle_is_closed_and_round() -> None:
    points = circle((3.0, -2.0, 1.0), 5.0)
    assert (points[0] == points[-1]).all()
    assert np.hypot(*(points[:, :2] - [3.0, -2.0]).T) == pytest.approx(5.0)
    assert set(points[:, 2]) == {1.0}


def test_a_shape_keeps_its_number_and_frees_it() -> None:
    numbers = Numbers()
    first, gone = numbers.frame([shape("a", "x"), shape("a", "y"), shape("b", "x")])
    assert [(number, s.key) for number, s in first] == [
        (0, ("a", "x")),
        (1, ("a", "y")),
        (0, ("b", "x")),
    ]
    assert gone == []
    second, gone = numbers.frame([shape("b", "x"), shape("a", "y")])
    assert gone == [(0, "a")]
    assert {s.key: number for number, s in second} == {("b", "x"): 0, ("a", "y"): 1}
    third, gone = numbers.frame([shape("a", "z"), shape("a", "y")])  # z takes what x has left
    assert {s.key: number for number, s in third} == {("a", "y"): 1, ("a", "z"): 0}
    assert gone == [(0, "b")]


def test_numbers_of_names_that_come_and_go_stay_small() -> None:
    numbers = Numbers()
    highest = max(
        number for k in range(500) for number, _ in numbers.frame([shape("a", f"vue_{k}")])[0]
    )
    assert highest <= 1
