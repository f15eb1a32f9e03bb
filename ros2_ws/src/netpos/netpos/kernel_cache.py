"""Where compiled kernels are kept: one folder per state of the sources.

Numba compiles a kernel anew when the file of the kernel has changed, not when that of a kernel it
calls has. A folder named after the contents of all of them leaves no stale one behind.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

_VARIABLE = "NUMBA_CACHE_DIR"
_KEPT = 4
_MARKS = (b"@kernel", b"@leaf", b"@inlined", b"@link", b"njit")
# The tables of the estimator, the indices of states and a loop are compiled into kernels, too.
_TABLES = ("sensors", "motion", "forms", "splits")
_FILES = ("state.py", "navigation_state.py", "least_squares.py")


def cache_folder(root: Path) -> Path:
    """Folder for the kernels of the package at ``root``, as its sources are now."""
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(root.rglob("*.py")):
        text = path.read_bytes()
        is_compiled = path.parent.name in _TABLES or path.name in _FILES
        if is_compiled or any(mark in text for mark in _MARKS):
            digest.update(str(path.relative_to(root)).encode() + b"\0" + text)
    return root / "__pycache__" / f"kernels-{digest.hexdigest()}"


def select(root: Path) -> None:
    """Tell Numba, before it is imported, where to keep the kernels of the package at ``root``.

    A place chosen by the user stands, and so does Numba's own where ``root`` cannot be written.
    """
    if _VARIABLE in os.environ:
        return
    folder = cache_folder(root)
    try:
        if not folder.exists():
            folder.mkdir(parents=True, exist_ok=True)
            others = sorted(folder.parent.glob("kernels-*"), key=lambda p: p.stat().st_mtime)
            for old in others[:-_KEPT]:
                shutil.rmtree(old, ignore_errors=True)
    except OSError:
        return
    os.environ[_VARIABLE] = str(folder)
