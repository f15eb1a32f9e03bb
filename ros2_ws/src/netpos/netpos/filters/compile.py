"""How the kernels are compiled: cached on disk, divisions by zero give infinity as in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

kernel: Callable[..., Any] = njit(cache=True, error_model="numpy", _nrt=True)
# For what allocates nothing: counting references to arrays would cost more than its arithmetic.
leaf: Callable[..., Any] = njit(cache=True, error_model="numpy", _nrt=False)
