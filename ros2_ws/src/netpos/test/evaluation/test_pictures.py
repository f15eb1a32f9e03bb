"""Pictures: what is drawn follows from the numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection
from netpos.evaluation import evaluate_bag
from netpos.evaluation.pictures import draw_bounds, draw_map, magnification, save
from PIL import Image


@pytest.mark.parametrize(
    ("length_m", "expected"),
    [(10.0, 1), (2.0, 1), (1.9, 2), (0.21, 10), (0.19, 20), (1e-9, 5000), (0.0, 1)],
)
def test_ellipses_are_enlarged_until_they_show_on_a_map_of_100_m(
    length_m: float, expected: int
) -> None:
    assert magnification(np.full(3, length_m), 100.0) == expected


def test_ellipses_are_those_of_scored_estimates(drive_bag: Path) -> None:
    evaluation = evaluate_bag(drive_bag, skip=50)
    pairs = evaluation.vues["vue_1"].scored.pairs
    (axes,) = draw_map(evaluation).axes
    (ellipses,) = (c for c in axes.collections if isinstance(c, EllipseCollection))
    offsets = ellipses.get_offsets()
    np.testing.assert_allclose(offsets[0], pairs.estimate.position[50, :2])
    np.testing.assert_allclose(offsets[-1], pairs.estimate.position[-1, :2])


def test_bounds_are_drawn_beside_the_error(drive_bag: Path) -> None:
    """The drive's errors have an sd of 0.6 m along the longer axis; 95 % of a unit Gaussian lie
    within 2.4477 (Rayleigh)."""
    evaluation = evaluate_bag(drive_bag)
    vue = evaluation.vues["vue_1"]
    with_level = [replace(s, protection_level_m=3.0) for s in vue.run.statuses[100:]]
    run = replace(vue.run, statuses=(*vue.run.statuses[:100], *with_level))
    levelled = replace(evaluation, vues={"vue_1": replace(vue, run=run)})
    (axes,) = draw_bounds(levelled).axes
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in axes.lines}
    counted = vue.scored.counted
    error = np.hypot(*(counted.estimate.position - counted.truth.position)[:, :2].T)
    np.testing.assert_allclose(lines["error"], error)
    np.testing.assert_allclose(lines["95 % ellipse, half axis"], 0.6 * 2.4477, rtol=1e-4)
    level = lines["protection level"]
    assert np.isnan(level[: 100 - 20]).all()
    assert (level[100 - 20 :] == 3.0).all()
    assert axes.get_yscale() == "log"
    (without,) = draw_bounds(evaluation).axes
    assert "protection level" not in {line.get_label() for line in without.lines}


def test_a_png_has_a_palette(drive_bag: Path, tmp_path: Path) -> None:
    save(draw_map(evaluate_bag(drive_bag)), tmp_path / "map.png")
    with Image.open(tmp_path / "map.png") as image:
        assert image.mode == "P"
        assert len(image.getcolors()) <= 64
