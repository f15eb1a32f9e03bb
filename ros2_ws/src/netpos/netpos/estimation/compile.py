"""How the kernels are compiled: cached on disk, divisions by zero give infinity as in NumPy.

Products may be added without rounding in between (fused multiply-add) in what allocates nothing;
nothing else is relaxed: sums keep their order, NaN and infinity their meaning.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import config, njit, types
from numba.core import cgutils, event
from numba.extending import intrinsic
from numba.np import arrayobj

from netpos.common.kernel_memory import keep_bitcode_packed

keep_bitcode_packed()  # before the first kernel is loaded

# Said of each that it is not inlined: what is compiled for an inlined caller would be, otherwise,
# with all that it calls.
kernel: Callable[..., Any] = njit(cache=True, error_model="numpy", _nrt=True, forceinline=False)
# For what allocates nothing: counting references to arrays would cost more than its arithmetic.
leaf: Callable[..., Any] = njit(
    cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=False
)
# A leaf that becomes part of its callers: a call with arrays costs about 10 ns for each of them,
# and a size the caller knows is known to the compiler.
inlined: Callable[..., Any] = njit(
    cache=True, error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True
)

# Becomes part of its callers before they are typed, and is not compiled by itself: for what only
# passes arguments on to kernels, which would be compiled once more with it.
spliced: Callable[..., Any] = njit(inline="always")

# An inlined closure made at import. Numba cannot find one in its cache again, and it need not: it
# is part of the callers that are cached.
link: Callable[..., Any] = njit(
    error_model="numpy", _nrt=False, fastmath={"contract"}, forceinline=True
)

# The same for a closure that allocates. It is called, and kept with the callers that are cached.
linked_kernel: Callable[..., Any] = njit(error_model="numpy", _nrt=True, forceinline=False)


def _local_array(_context: Any, *shape: Any) -> Any:
    """Array of a shape known at compile time on the stack of the kernel that calls it, its entries
    undefined.

    Where indices are known, too, its entries live in registers. Not to be returned.
    """
    sizes = [size.literal_value for size in shape]
    array = types.Array(types.float64, len(sizes), "C")

    def generate(context: Any, builder: Any, _signature: Any, _args: Any) -> Any:
        def constant(value: int) -> Any:
            return context.get_constant(types.intp, value)

        strides = [8]
        for size in sizes[:0:-1]:
            strides.insert(0, strides[0] * size)
        memory = cgutils.alloca_once(
            builder,
            context.get_value_type(types.float64),
            size=constant(strides[0] * sizes[0] // 8),
        )
        made = arrayobj.make_array(array)(context, builder)
        arrayobj.populate_array(
            made,
            data=memory,
            shape=[constant(size) for size in sizes],
            strides=[constant(stride) for stride in strides],
            itemsize=constant(8),
            meminfo=None,
        )
        return made._getvalue()

    return array(types.StarArgTuple(shape)), generate


def _python_array(*shape: int) -> Any:
    return np.empty(shape)


# Without the compiler (NUMBA_DISABLE_JIT: debugging, scripts/mutate_kernels.py) an ordinary array.
local_array: Callable[..., Any] = (
    _python_array if config.DISABLE_JIT else intrinsic(prefer_literal=True)(_local_array)
)


SENTENCE = (
    "netpos: compiling kernels for this machine; once, some seconds for each kind of tracker\n"
)


class _Once(event.Listener):  # type: ignore[misc]
    """Tells of the first compilation and no other."""

    def on_start(self, _: event.Event) -> None:
        event.unregister(event_kind, self)
        sys.stderr.write(SENTENCE)
        sys.stderr.flush()

    def on_end(self, _: event.Event) -> None:
        """Nothing is told."""


event_kind = "numba:compile"


def tell_first_compilation() -> None:
    """Have the first compilation told on stderr, where no kernel has been compiled before."""
    folder = os.environ.get("NUMBA_CACHE_DIR", "")
    if folder and not any(Path(folder).rglob("*.nbi")):
        event.register(event_kind, _Once())
