"""The pages of this source tree: rendered from what is recorded, linked, with their pictures."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest
from netpos.evaluation.pages import PageError, Site
from netpos.evaluation.pages.layout import read_layout
from netpos.evaluation.pages.tables import TableError

ROOT = Path(__file__).resolve().parents[6]
RESULTS = ROOT / "docs/results"
PICTURE_BYTES = 60_000
DOCUMENTS = sorted(
    [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "bags").rglob("*.md")]
)
LINK = re.compile(r'\]\(([^)\s]+)\)|<img src="([^"]+)"')


@cache
def site() -> Site:
    return Site(ROOT)


def links(document: Path) -> list[str]:
    text = document.read_text(encoding="utf-8")
    return [first or second for first, second in LINK.findall(text)]


@pytest.mark.parametrize("page", Site(ROOT).pages(), ids=lambda page: page.name)
def test_a_page_agrees_with_what_is_recorded(page: Path) -> None:
    assert page.read_text(encoding="utf-8") == site().rendered(page), (
        f"{page.relative_to(ROOT)} disagrees with docs/results/recorded; run "
        "python scripts/render_results.py"
    )


def test_every_table_and_recorded_file_is_on_a_page() -> None:
    markers = re.findall(
        r"<!-- table: (\S+) (.+?) -->", "".join(page.read_text() for page in site().pages())
    )
    assert set(site().layout.tables) <= set(markers)
    assert set(site().recorded) == {recorded for recorded, _ in markers} - {"all"}


@pytest.mark.parametrize("name", sorted(r.name for r in Site(ROOT).recorded.values() if r.judged))
def test_a_page_begins_with_what_is_missed(name: str) -> None:
    text = (RESULTS / f"{name}.md").read_text(encoding="utf-8")
    markers = re.findall(r"<!-- table: (\S+) (.+?) -->", text)
    assert markers[:2] == [(name, "method"), (name, "missed")]


def test_charts_show_what_is_recorded() -> None:
    for path, description in site().charts().items():
        assert description in path.read_text(encoding="utf-8"), (
            f"{path.name} shows other figures than are recorded; run "
            "python scripts/render_results.py"
        )


def test_pictures_are_small_and_shown() -> None:
    shown = {(page.parent / link).resolve() for page in site().pages() for link in links(page)}
    pictures = sorted((RESULTS / "pictures").iterdir())
    assert pictures
    for picture in pictures:
        assert picture.stat().st_size < PICTURE_BYTES, picture
        assert picture in shown, picture


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda d: str(d.relative_to(ROOT)))
def test_relative_links_lead_somewhere(document: Path) -> None:
    for link in links(document):
        if not re.match(r"[a-z]+:", link) and not link.startswith("#"):
            assert (document.parent / link.split("#")[0]).exists(), link


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A tree of one page, one table and one recorded row."""
    results = tmp_path / "docs/results"
    (results / "recorded").mkdir(parents=True)
    (results / "recorded/a.json").write_text(
        '{"paper": "a", "runs": 1, "seed": 1, "wall_s": 1.0, "rows": '
        '[{"name": "E: RMSE", "unit": "m", "paper": 1.0, "ours": 0.5, "ok": true}]}'
    )
    (results / "tables.yaml").write_text(
        "full_runs: {}\ntables: {a: {t: {rows: E, columns: [{title: RMSE, figure: RMSE}]}}}\n"
        "charts: {a.svg: {recorded: a, rows: E, ylabel: m, series: [{title: o, figure: RMSE}]}}\n"
    )
    (tmp_path / "README.md").write_text("<!-- table: a t -->\n<!-- end of table -->\n")
    return tmp_path


def test_a_site_is_written_and_stays_when_written_again(small: Path) -> None:
    page, chart = Site(small).write()
    assert "| E | 0.5 |" in page.read_text()
    assert chart.name == "a.svg"
    before = page.read_bytes(), chart.read_bytes()
    Site(small).write()
    assert (page.read_bytes(), chart.read_bytes()) == before


@pytest.mark.parametrize(
    ("marker", "complaint"),
    [("b t", "nothing recorded for b"), ("a u", "no table 'u' of a"), ("all t", "for all")],
)
def test_a_page_names_only_what_there_is(small: Path, marker: str, complaint: str) -> None:
    page = small / "README.md"
    page.write_text(f"<!-- table: {marker} -->\n<!-- end of table -->\n")
    with pytest.raises(PageError, match=rf"README\.md: .*{complaint}"):
        Site(small).rendered(page)


def test_a_pattern_without_a_row_names_the_page(small: Path) -> None:
    layout = small / "docs/results/tables.yaml"
    layout.write_text(layout.read_text().replace("rows: E,", "rows: F,", 1))
    with pytest.raises(PageError, match=r"README\.md: nothing recorded for a matches 'F'"):
        Site(small).rendered(small / "README.md")


@pytest.mark.parametrize(
    ("old", "new"),
    [("title: RMSE,", "name: RMSE,"), ("rows: E, columns", "colums: E, columns"),
     ("figure: RMSE}]}}}", "figure: RMSE, show: [mine]}]}}}")],
)  # fmt: skip
def test_a_typo_in_the_layout_stops_it(small: Path, old: str, new: str) -> None:
    layout = small / "docs/results/tables.yaml"
    text = layout.read_text()
    assert old in text
    layout.write_text(text.replace(old, new, 1))
    with pytest.raises(TableError, match=r"tables\.yaml: a t"):
        read_layout(layout)
