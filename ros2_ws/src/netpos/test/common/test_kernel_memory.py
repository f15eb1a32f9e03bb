"""Memory that the compiler takes is handed back, and the compiler still works."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

_PROGRAM = """
import numpy as np
from numba import njit
from netpos.common.kernel_memory import give_back_compiler

def resident_kb():
    for line in open("/proc/self/status"):
        if line.startswith("RssFile:"):
            return int(line.split()[1])

@njit
def total(x):
    return x.sum()

assert total(np.arange(4.0)) == 6.0
before = resident_kb()
given = give_back_compiler()
print(given, before - resident_kb())
assert total(np.arange(4)) == 6, "another kernel compiles"
assert total(np.arange(3.0)) == 3.0
"""

_KERNELS = """
import numpy as np
from netpos.estimation.compile import kernel

@kernel
def squares(x):
    return (x * x).sum()

@kernel
def doubled(x):
    return 2.0 * squares(x)
"""

_LOADED = """
import netpos.common.kernel_memory as memory
{before}
from netpos.tracking.warm_up import warm_up

warm_up("")
memory.give_back_compiler()
with open("/proc/self/status") as status:
    print(*(line.split()[1] for line in status if line.startswith("RssAnon:")))
"""


def _run(program: str, **surroundings: str) -> str:
    """What a process of its own prints."""
    result = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **surroundings},
    )
    return result.stdout


def test_the_compiler_is_handed_back_and_comes_back() -> None:
    """In a process of its own. Compiling touches tens of megabytes of machine code."""
    given, freed_kb = map(int, _run(_PROGRAM).split())
    assert given > 20e6
    assert freed_kb > 20_000


def test_without_a_compiler_there_is_nothing_to_hand_back() -> None:
    program = "from netpos.common.kernel_memory import give_back_compiler as g; print(g())"
    assert int(_run(program)) == 0


def test_kernels_of_the_cache_become_part_of_others(tmp_path: Path) -> None:
    """In the second process the one that is called comes from the cache, the caller does not."""
    (tmp_path / "kernels.py").write_text(_KERNELS, encoding="utf-8")
    places = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    begin = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import numpy as np, kernels\n"
    assert _run(begin + "print(kernels.squares(np.arange(4.0)))", **places).split() == ["14.0"]
    again = (
        "loaded = kernels.squares(np.arange(4.0)); hits = kernels.squares.stats.cache_hits\n"
        "print(loaded, sum(hits.values()), kernels.doubled(np.arange(4.0)))"
    )
    assert _run(begin + again, **places).split() == ["14.0", "1", "28.0"]


def test_loaded_kernels_leave_no_bitcode_in_memory() -> None:
    """Beside a process in which the compiler keeps what it reads: a third of its memory less."""
    kept = "memory.keep_bitcode_packed = lambda: None"
    packed_kb, read_kb = (float(_run(_LOADED.format(before=b))) for b in ("", kept))
    assert packed_kb < 0.8 * read_kb
