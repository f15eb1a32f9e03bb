"""All result pages of a source tree, rendered from what was recorded."""

from __future__ import annotations

from pathlib import Path

from netpos.evaluation.pages import charts, tables
from netpos.evaluation.pages.layout import read_layout
from netpos.evaluation.pages.markers import PageError, fill
from netpos.evaluation.pages.recorded import read_recorded

RESULTS = Path("docs/results")


class Site:
    """The pages below a folder: ``README.md`` and ``docs/results/*.md``.

    Raises
    ------
    ValueError  the layout or a recorded file cannot be read; the text names it
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.layout = read_layout(root / RESULTS / "tables.yaml")
        files = sorted((root / RESULTS / "recorded").glob("*.json"))
        self.recorded = {file.stem: read_recorded(file, self.layout.full_runs) for file in files}

    def pages(self) -> list[Path]:
        """The pages, sorted."""
        return [self.root / "README.md", *sorted((self.root / RESULTS).glob("*.md"))]

    def rendered(self, page: Path) -> str:
        """The page with its tables.

        Raises
        ------
        PageError  a marker, or a table it names, is wrong
        """
        try:
            return fill(page.read_text(encoding="utf-8"), self.table)
        except ValueError as error:
            raise PageError(f"{page.relative_to(self.root)}: {error}") from error

    def table(self, recorded: str, name: str) -> str:
        """One table: of the layout, or ``method``, ``missed``; ``all missed`` counts them.

        Raises
        ------
        PageError, TableError  there is no such table, or nothing recorded for it
        """
        if (recorded, name) == ("all", "missed"):
            return tables.summary(self.recorded.values())
        if recorded not in self.recorded:
            raise PageError(f"nothing recorded for {recorded}; run scripts/results.sh {recorded}")
        measured = self.recorded[recorded]
        if name == "method":
            return f"{measured.method}\n"
        if name == "missed":
            return tables.missed(measured)
        if (recorded, name) not in self.layout.tables:
            raise PageError(f"tables.yaml has no table {name!r} of {recorded}")
        return tables.render(self.layout.tables[recorded, name], measured)

    def charts(self) -> dict[Path, str]:
        """The description each chart must carry, by its file."""
        return {
            self.root / RESULTS / "pictures" / name: charts.description(
                charts.bars(chart, self.recorded[chart.recorded])
            )
            for name, chart in self.layout.charts.items()
        }

    def write(self) -> list[Path]:
        """Render every page and chart; returns the files written."""
        written = []
        for page in self.pages():
            page.write_text(self.rendered(page), encoding="utf-8")
            written.append(page)
        for path, chart in zip(self.charts(), self.layout.charts.values(), strict=True):
            charts.write(chart, self.recorded[chart.recorded], path)
            written.append(path)
        return written
