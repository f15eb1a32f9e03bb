"""Markers: what is between them is replaced, everything else stays."""

from __future__ import annotations

import pytest
from netpos.evaluation.pages.markers import PageError, fill

PAGE = (
    "# Page\n<!-- table: a one -->\nold\n<!-- end of table -->\ntext\n"
    "<!-- table: b the other -->\n<!-- end of table -->\nend\n"
)


def table(recorded: str, name: str) -> str:
    return f"[{recorded}|{name}]\n"


def test_tables_are_replaced_and_text_stays() -> None:
    expected = (
        "# Page\n<!-- table: a one -->\n\n[a|one]\n\n<!-- end of table -->\ntext\n"
        "<!-- table: b the other -->\n\n[b|the other]\n\n<!-- end of table -->\nend\n"
    )
    assert fill(PAGE, table) == expected
    assert fill(expected, table) == expected


def test_a_page_without_tables_stays() -> None:
    assert fill("# Page\n", table) == "# Page\n"


@pytest.mark.parametrize(
    "page",
    [
        "<!-- table: a one -->\nold\n",
        "<!-- table: a one -->\n<!-- table: b two -->\n<!-- end of table -->\n",
        "<!-- end of table -->\n<!-- table: a one -->\n<!-- end of table -->\n",
        "<!-- table: a one -->\n<!-- end of table -->\n<!-- end of table -->\n",
        "<!-- table: one -->\n<!-- end of table -->\n",
    ],
)
def test_a_marker_without_its_partner_is_an_error(page: str) -> None:
    with pytest.raises(PageError):
        fill(page, table)
