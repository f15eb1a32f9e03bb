"""Render the tables and charts of README.md and docs/results from docs/results/recorded:
python scripts/render_results.py."""

from __future__ import annotations

import sys
from pathlib import Path

from netpos.evaluation.pages import Site


def main() -> None:
    """Write every page and chart; exit 1 where one cannot be rendered."""
    root = Path(__file__).resolve().parents[1]
    try:
        for path in Site(root).write():
            print(f"wrote {path.relative_to(root)}")
    except ValueError as error:
        sys.exit(f"netpos: {error}")


if __name__ == "__main__":
    main()
