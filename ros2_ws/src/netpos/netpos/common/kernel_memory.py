"""What the compiler of the kernels takes of the memory of a process that only loads them."""

from __future__ import annotations

import ctypes
import mmap
from pathlib import Path
from typing import Any

_COMPILER = "libllvmlite"


def keep_bitcode_packed() -> None:
    """Have the bitcode of kernels that come from the cache kept as it is there, and read again
    where another kernel that calls them is compiled; once in a process.

    From its bitcode a kernel becomes part of others. The compiler keeps what it has read, nearly
    ten times as large, for as long as the kernel is loaded.
    """
    from numba.core import codegen as compiler  # noqa: PLC0415 - loaded where it is used

    libraries = compiler.CPUCodeLibrary
    load, module_for_linking = libraries._unserialize, libraries._get_module_for_linking

    def load_packed(_library_class: type, codegen: Any, state: tuple[str, str, Any]) -> Any:
        library, (_, kind, data) = load(codegen, state), state
        if kind == "object":
            library._shared_module, library.packed_bitcode = None, data[1]
        return library

    def module_read_again(library: Any) -> Any:
        bitcode = vars(library).pop("packed_bitcode", None)
        if bitcode is not None:
            library._shared_module = compiler.ll.parse_bitcode(bitcode)
        return module_for_linking(library)

    libraries._unserialize = classmethod(load_packed)
    libraries._get_module_for_linking = module_read_again


def give_back_compiler() -> int:
    """Hand back, once the kernels are loaded, the memory that the machine code of the compiler
    takes and that loading has left free; the number of bytes of address space of the code, 0 on
    other systems than Linux with the GNU C library.

    Of the code only pages go, which nobody writes; they come back from their file when another
    kernel is loaded.
    """
    try:
        mappings = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
        system = ctypes.CDLL(None)
        advise, trim = system.madvise, system.malloc_trim
    except (OSError, AttributeError):
        return 0
    trim(0)
    given = 0
    for mapping in mappings:
        span, mode, _, _, _, *path = mapping.split(maxsplit=5)
        if mode == "r-xp" and path and Path(path[0]).name.startswith(_COMPILER):
            first, end = (int(address, 16) for address in span.split("-"))
            size = end - first
            if advise(ctypes.c_void_p(first), ctypes.c_size_t(size), mmap.MADV_DONTNEED) == 0:
                given += size
    return given
