"""Bar charts: the bars are the recorded values."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from matplotlib.container import BarContainer
from netpos.evaluation.pages.charts import Chart, Series, bars, description, draw, write
from netpos.evaluation.pages.recorded import Entry, Recorded
from netpos.evaluation.pages.tables import TableError

RECORDED = Recorded(
    name="some2000",
    entries=(
        Entry(experiment="A, slow", figure="RMSE", paper=1.0, ours=0.25),
        Entry(experiment="A, slow", figure="mean", ours=9.0),
        Entry(experiment="A, fast", figure="RMSE", ours=0.5),
    ),
    method="",
)
CHART = Chart(
    recorded="some2000",
    rows="A, (.*)",
    ylabel="RMSE [m]",
    series=(
        Series(title="paper", figure="RMSE", show="paper"),
        Series(title="its filter", figure="RMSE", show="baseline"),
        Series(title="ours", figure="RMSE"),
    ),
)


def test_series_without_values_are_left_out() -> None:
    values = bars(CHART, RECORDED)
    assert values == {"paper": {"slow": 1.0}, "ours": {"slow": 0.25, "fast": 0.5}}
    assert description(values) == "paper: slow 1; ours: slow 0.25, fast 0.5"


def test_bars_have_the_height_of_the_values_and_do_not_overlap() -> None:
    (axes,) = draw(CHART, bars(CHART, RECORDED)).axes
    drawn = [box for box in axes.containers if isinstance(box, BarContainer)]
    heights = {box.get_label(): [patch.get_height() for patch in box] for box in drawn}
    assert heights == {"paper": [1.0], "ours": [0.25, 0.5]}
    spans = sorted((p.get_x(), p.get_x() + p.get_width()) for box in drawn for p in box)
    assert all(end <= start for (_, end), (start, _) in pairwise(spans))
    assert axes.get_ylabel() == "RMSE [m]"
    assert [label.get_text() for label in axes.get_xticklabels()] == ["slow", "fast"]


def test_the_file_carries_the_values_and_is_the_same_again(tmp_path: Path) -> None:
    first, second = tmp_path / "a.svg", tmp_path / "b.svg"
    for path in (first, second):
        write(CHART, RECORDED, path)
    assert "paper: slow 1; ours: slow 0.25, fast 0.5" in first.read_text()
    assert first.read_bytes() == second.read_bytes()


def test_nothing_to_draw_is_an_error() -> None:
    with pytest.raises(TableError, match="nothing recorded"):
        bars(CHART, Recorded(name="none", entries=(), method=""))
