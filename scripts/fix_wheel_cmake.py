"""Point the CMake files of the ROS wheels at this interpreter.

The wheels carry the include folders of the Python and NumPy they were built with; CMake stops at
folders that are not there.
"""

from __future__ import annotations

import re
import sys
import sysconfig
from pathlib import Path

import numpy as np

PYTHON_INCLUDE = re.compile(r"/opt/python/[^/;\"]+/include/python3\.\d+")
NUMPY_INCLUDE = re.compile(r"/opt/python/[^;\"]*/numpy/_core/include")


def main(venv: Path) -> None:
    """Rewrite every exported CMake file below ``venv/share`` that names the build host."""
    for path in sorted((venv / "share").rglob("*.cmake")):
        text = path.read_text(encoding="utf-8")
        fixed = NUMPY_INCLUDE.sub(np.get_include(), text)
        fixed = PYTHON_INCLUDE.sub(sysconfig.get_path("include"), fixed)
        if fixed != text:
            path.write_text(fixed, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
