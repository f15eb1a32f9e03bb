"""What the compiler of the kernels holds once they are loaded."""

from __future__ import annotations

import ctypes
import mmap
from pathlib import Path

_COMPILER = "libllvmlite"


def give_back_compiler() -> int:
    """Hand back the memory that the machine code of the compiler takes, once the kernels are
    loaded; the number of bytes of address space this concerns, 0 on other systems than Linux.

    Only pages of code go, which nobody writes; they come back from their file when another kernel
    is loaded.
    """
    try:
        mappings = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
        advise = ctypes.CDLL(None).madvise
    except (OSError, AttributeError):
        return 0
    given = 0
    for mapping in mappings:
        span, mode, _, _, _, *path = mapping.split(maxsplit=5)
        if mode == "r-xp" and path and Path(path[0]).name.startswith(_COMPILER):
            first, end = (int(address, 16) for address in span.split("-"))
            size = end - first
            if advise(ctypes.c_void_p(first), ctypes.c_size_t(size), mmap.MADV_DONTNEED) == 0:
                given += size
    return given
