"""``docs/results/tables.yaml``: every table and chart of the result pages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from netpos.common.yaml_text import load_yaml
from netpos.evaluation.pages.charts import Chart, Series
from netpos.evaluation.pages.tables import SOURCES, Column, Table, TableError, checked


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """tables by what was recorded and their name; charts by file name; full_runs: runs of the
    full measurement by paper."""

    tables: Mapping[tuple[str, str], Table]
    charts: Mapping[str, Chart]
    full_runs: Mapping[str, int]


def read_layout(path: Path) -> Layout:
    """Read the layout.

    Raises
    ------
    TableError  a key is unknown or missing; the text says where
    """
    data = checked(_File, load_yaml(path.read_text(encoding="utf-8")), path.name)
    tables = {
        (recorded, name): _table(spec, f"{path.name}: {recorded} {name}")
        for recorded, specs in data.tables.items()
        for name, spec in specs.items()
    }
    charts = {name: _chart(spec, f"{path.name}: {name}") for name, spec in data.charts.items()}
    return Layout(tables=tables, charts=charts, full_runs=data.full_runs)


@dataclass(frozen=True, slots=True, kw_only=True)
class _File:
    full_runs: Mapping[str, int]
    tables: Mapping[str, Mapping[str, dict[str, Any]]]
    charts: Mapping[str, dict[str, Any]]


def _table(spec: dict[str, Any], where: str) -> Table:
    columns = tuple(_column(column, where) for column in spec.get("columns", ()))
    return checked(Table, {**spec, "columns": columns}, where)


def _column(spec: dict[str, Any], where: str) -> Column:
    show = tuple(spec.get("show", ("ours",)))
    for source in show:
        if source not in SOURCES:
            raise TableError(f"{where}: shows {source!r}; known: {', '.join(SOURCES)}")
    return checked(Column, {**spec, "show": show}, where)


def _chart(spec: dict[str, Any], where: str) -> Chart:
    series = tuple(checked(Series, one, where) for one in spec.get("series", ()))
    return checked(Chart, {**spec, "series": series}, where)
