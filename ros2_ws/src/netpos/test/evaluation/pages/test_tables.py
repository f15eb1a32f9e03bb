"""Tables: exact Markdown of figures made by hand."""

from __future__ import annotations

import pytest
from netpos.evaluation.pages.recorded import Entry, Recorded
from netpos.evaluation.pages.tables import Column, Table, TableError, missed, render, summary

ENTRIES = (
    Entry(experiment="A, slow", figure="RMSE", unit="m", paper=1.0, ours=1.5, ok=False,
          target="1 m"),
    Entry(experiment="A, slow", figure="NEES, mean", ours=2.5, ok=True),
    Entry(experiment="A, slow", figure="NEES, lower", ours=1.5),
    Entry(experiment="A, slow", figure="NEES, upper", ours=2.75),
    Entry(experiment="A, fast", figure="RMSE", unit="m", paper=1.0, ours=0.5, ok=True),
    Entry(experiment="A, fast", figure="share", ours=0.125),
    Entry(experiment="B", figure="RMS north", ours=1.0),
    Entry(experiment="B", figure="RMS east", ours=2.0, ok=False),
)  # fmt: skip
RECORDED = Recorded(name="some2000", entries=ENTRIES, method="By hand.")


def test_lines_are_experiments_and_missed_figures_bold() -> None:
    columns = (
        Column(title="RMSE [m]", figure="RMSE", show=("paper", "baseline", "ours")),
        Column(title="NEES", figure="NEES, mean", bounds="NEES, (lower|upper)"),
        Column(title="share", figure="share", percent=True),
    )
    assert render(Table(rows="A, (.*)", columns=columns), RECORDED) == (
        "| experiment | RMSE [m], paper | RMSE [m], ours | NEES | share |\n"
        "| --- | --- | --- | --- | --- |\n"
        "| slow | 1 | **1.5** | 2.5 (1.5 to 2.75) | – |\n"
        "| fast | 1 | 0.5 | – | 12.5 % |\n"
    )


def test_several_figures_of_a_column_are_joined() -> None:
    table = Table(rows="B", heading="drive", columns=(Column(title="RMS", figure="RMS .*"),))
    assert render(table, RECORDED) == "| drive | RMS |\n| --- | --- |\n| B | 1 / **2** |\n"


def test_lines_without_a_figure_that_they_must_have_are_left_out() -> None:
    nothing = Entry(experiment="C", figure="RMSE", ours=None)
    recorded = Recorded(name="some2000", entries=(*ENTRIES, nothing), method="By hand.")
    table = Table(rows="(.*)", having="RMSE", columns=(Column(title="RMSE", figure="RMSE"),))
    assert render(table, recorded).splitlines()[2:] == [
        "| A, slow | **1.5** |",
        "| A, fast | 0.5 |",
    ]


def test_a_table_without_columns_lists_every_figure() -> None:
    assert render(Table(rows="A, fast|B"), RECORDED) == (
        "| figure | unit | paper | ours |\n| --- | --- | --- | --- |\n"
        "| A, fast: RMSE | m | 1 | 0.5 |\n"
        "| A, fast: share |  | – | 0.125 |\n"
        "| B: RMS north |  | – | 1 |\n"
        "| B: RMS east |  | – | **2** |\n"
    )


@pytest.mark.parametrize(
    "table",
    [
        Table(rows="A"),  # an experiment must match as a whole
        Table(rows="B", columns=(Column(title="RMSE", figure="RMSE"),)),
        Table(rows="B", columns=(Column(title="RMS", figure="RMS"),)),
        Table(rows="B", having="RMSE", columns=(Column(title="RMS", figure="RMS .*"),)),
        Table(rows="B", columns=(Column(title="RMS", figure="RMS .*", bounds="NEES.*"),)),
    ],
)
def test_a_pattern_that_matches_nothing_is_an_error(table: Table) -> None:
    with pytest.raises(TableError, match="matches"):
        render(table, RECORDED)


def test_missed_figures_are_listed_with_unit_and_target() -> None:
    assert missed(RECORDED) == (
        "2 of 4 figures with a target miss it:\n\n"
        "| missed | ours | target |\n| --- | --- | --- |\n"
        "| A, slow: RMSE | **1.5 m** | 1 m |\n"
        "| B: RMS east | **2** | own requirement |\n"
    )
    kept = Recorded(name="kept", entries=ENTRIES[1:5], method="")
    assert missed(kept) == "0 of 2 figures with a target miss it.\n"


def test_the_summary_counts_per_page_and_leaves_out_what_is_not_judged() -> None:
    shown = Recorded(name="shown", entries=ENTRIES[2:4], method="")
    assert summary([RECORDED, shown]).splitlines()[2:] == ["| [some2000](some2000.md) | 2 | 4 |"]
