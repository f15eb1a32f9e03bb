#!/usr/bin/env python3
"""The HTML report beside a notebook with the same figures and tables that nbconvert makes a page.

    scripts/compare_report.py BAG

BAG has tracks and ground truth. The figures are those of docs/decisions/0117.
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import nbformat
import netpos
from nbconvert import HTMLExporter
from netpos.evaluation.report import report

sys.path.insert(0, str(Path(__file__).parent / "site"))
from notebooks import executed

# All that a template could leave to a library: numbers as tables, plots one below the other.
CELLS = (
    "import netpos\nimport pandas as pd\nfrom netpos.evaluation.report import plots, tables\n"
    "import plotly.io\nplotly.io.renderers.default = 'notebook'\n"
    "one = netpos.evaluate({bag!r}, skip=2, residuals=True)",
    "from IPython.display import display\n"
    "for table in tables.of_evaluation(one, {{}}):\n"
    "    display(pd.DataFrame(table['rows'], columns=table['head']))",
    "plots.map_of_evaluation(one)",
    "plots.errors(one)",
    "plots.integrity(one)[0]",
    "for name, vue in one.vues.items():\n    display(plots.residuals(name, vue.series))",
)
_ELSEWHERE = re.compile(r"<(?:script|link)\b[^>]*?\b(?:src|href)=[\"']?https?://([^/\"']+)")
_CONTROLS = re.compile(r"<(?:input|button|select)\b(?![^>]*hidden)")


def by_nbconvert(bag: Path, out: Path) -> None:
    """A notebook, run and exported without its code."""
    cells = [nbformat.v4.new_code_cell(text.format(bag=str(bag))) for text in CELLS]
    notebook = nbformat.v4.new_notebook(cells=cells)
    path = out.with_suffix(".ipynb")
    nbformat.write(notebook, path)
    text, _ = HTMLExporter(exclude_input=True).from_notebook_node(executed(path, out.parent))
    out.write_text(text, encoding="utf-8")


def measure(name: str, make: Callable[[Path], object], folder: Path) -> None:
    """One line of the table."""
    out = folder / f"{name}.html"
    start = time.perf_counter()
    make(out)
    took = time.perf_counter() - start
    text = out.read_text(encoding="utf-8")
    outside = sorted(set(_ELSEWHERE.findall(text)))
    print(
        f"{name:10} {took:6.1f} s {len(text.encode()) / 1e6:6.1f} MB, controls "
        f"{len(_CONTROLS.findall(text))}, loads from {', '.join(outside) or 'nowhere else'}"
    )


def lines() -> None:
    """Lines of our report by file."""
    folder = Path(report.__file__).parent
    counts = {
        path.name: len(path.read_text(encoding="utf-8").splitlines())
        for path in sorted(folder.iterdir())
        if path.suffix in {".py", ".html", ".js"}
    }
    print(sum(counts.values()), "lines:", ", ".join(f"{n} {c}" for n, c in counts.items()))


def main() -> None:
    bag = Path(sys.argv[1]).resolve()
    lines()
    netpos.evaluate(bag, skip=2)  # imports and files are in memory for both
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measure("netpos", lambda out: report.write_report([bag], out, skip=2), folder)
        measure("nbconvert", lambda out: by_nbconvert(bag, out), folder)


if __name__ == "__main__":
    main()
