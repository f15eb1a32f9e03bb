"""The yardstick: the filter of ``yardstick.c``, compiled here and called in one go."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from netpos.bench.common import Unavailable
from netpos.bench.problem import DT_S, HEIGHT_M, MOTION, ROWS, Problem
from netpos.estimation import measurement
from netpos.estimation.motion import Parameter
from netpos.messages.values import Array

FLAGS = ("-std=gnu11", "-O3", "-march=native", "-shared", "-fPIC")
_COLUMNS = ("KIND", "VALUE", "VARIANCE", "ORIGIN", "AXES", "ROW_WIDTH")


class Yardstick:
    """The compiled library; ``folder`` has to outlive it.

    Raises ``Unavailable`` where there is no C compiler or it fails.
    """

    def __init__(self, folder: Path) -> None:
        library = folder / "yardstick.so"
        _compile(library)
        self._run = ctypes.CDLL(str(library)).run
        array = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")
        self._run.argtypes = [array, ctypes.c_long, *([ctypes.c_double] * 5), array, array]
        self._run.restype = None

    def run(self, problem: Problem) -> tuple[Array, Array]:
        """Mean (6,) and covariance (6, 6) after all epochs."""
        mean, cov = problem.mean.copy(), problem.cov.copy()
        noise = [float(MOTION[p]) for p in (Parameter.ACCEL, Parameter.OFFSET_DENSITY)]
        noise.append(float(MOTION[Parameter.DRIFT_DENSITY]))
        self._run(problem.rows, problem.epochs, DT_S, *noise, HEIGHT_M, mean, cov)
        return mean, cov


def compiler() -> str:
    """Path of the C compiler: $CC, else cc. Raises ``Unavailable`` where there is none."""
    name = os.environ.get("CC") or "cc"
    path = shutil.which(name)
    if path is None:
        raise Unavailable(f"no C compiler: {name} is not on PATH; install one or set CC.")
    return path


def _compile(library: Path) -> None:
    defines = [f"-D{name}={getattr(measurement, name)}" for name in _COLUMNS]
    defines += [f"-DTOA={int(measurement.Kind.TOA)}", f"-DROWS={ROWS}"]
    with as_file(files(__package__) / "yardstick.c") as source:
        command = [compiler(), *FLAGS, *defines, "-o", str(library), str(source), "-lm"]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        text = result.stderr.strip().splitlines()
        raise Unavailable(f"the C compiler failed: {text[0] if text else command}.")
