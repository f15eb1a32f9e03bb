"""The compiler's memory is handed back, and the compiler still works."""

from __future__ import annotations

import subprocess
import sys

_PROGRAM = """
import numpy as np
from numba import njit
from netpos.kernel_memory import give_back_compiler

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


def test_the_compiler_is_handed_back_and_comes_back() -> None:
    """In a process of its own. Compiling touches tens of megabytes of machine code."""
    result = subprocess.run(
        [sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True
    )
    given, freed_kb = map(int, result.stdout.split())
    assert given > 20e6
    assert freed_kb > 20_000


def test_without_a_compiler_there_is_nothing_to_hand_back() -> None:
    program = "from netpos.kernel_memory import give_back_compiler as g; print(g())"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert int(result.stdout) == 0
