"""The compiled choice of a sensor, a motion model or a filter form."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import netpos
import pytest
from netpos.estimation.compile import link
from netpos.estimation.dispatch import choose, is_one_of
from netpos.kernel_cache import cache_folder


@link
def _double(value: float, _more: int) -> float:
    return 2.0 * value


@link
def _more(value: float, more: int) -> float:
    return value + more


@link
def _nothing(_value: float, _more: int) -> float:
    return 0.0


@pytest.mark.parametrize(("kind", "expected"), [(5, 6.0), (2, 7.0), (3, 0.0), (9, 0.0), (-1, 0.0)])
def test_the_model_of_the_number_is_called(kind: int, expected: float) -> None:
    chosen = choose([(5, _double), (3, None), (2, _more)], _nothing)
    assert chosen(kind, 3.0, 4) == expected


def test_no_models_leave_the_last_one() -> None:
    assert choose([], _more)(0, 3.0, 4) == 7.0


def test_members_of_a_set_of_numbers() -> None:
    chosen = is_one_of([0, 7, 62, 7])
    assert [kind for kind in range(63) if chosen(kind)] == [0, 7, 62]
    assert not any(is_one_of([])(kind) for kind in range(63))


_SECOND_START = """
import numpy as np
from netpos.estimation.measurement import predict_row
from netpos.estimation.sensors.row import ROW_WIDTH
row = np.zeros(ROW_WIDTH)
predict_row(row, np.ones(6), 0.0, np.zeros(6))
print(sum(predict_row.stats.cache_hits.values()), sum(predict_row.stats.cache_misses.values()))
"""


@pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="nothing is compiled")
def test_a_second_process_compiles_nothing() -> None:
    """Closures are compiled as parts of the kernels that are cached."""
    starts = [
        subprocess.run(
            [sys.executable, "-c", _SECOND_START], capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(2)
    ]
    assert starts[1] == ["1", "0"]


@pytest.mark.parametrize(
    "name",
    [
        *("sensors/table", "sensors/azimuth", "sensors/row", "state"),
        *("motion/table", "motion/parameters", "motion/inertial", "forms/table", "forms/form"),
    ],
)
def test_a_changed_entry_has_kernels_of_its_own(tmp_path: Path, name: str) -> None:
    """Columns, the tables and indices of states are compiled into kernels of other files."""
    root = tmp_path / "netpos"
    room = Path("estimation")
    shutil.copytree(Path(netpos.__file__).parent / room, root / room)
    before = cache_folder(root)
    assert cache_folder(root) == before
    with (root / room / f"{name}.py").open("a", encoding="utf-8") as file:
        file.write("# one line more\n")
    assert cache_folder(root) != before
