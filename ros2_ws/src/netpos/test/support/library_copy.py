"""A copy of the library to which a page of the documents adds something."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import netpos

DOCS = Path(__file__).resolve().parents[5] / "docs"


DRIVE = """
import json
import numpy as np
from netpos.messages.values import Beacon, InitialPose, Odometry
from netpos.scenario import Scenario, Simulation
from netpos.tracking import Tracker, TrackerConfig


def street(quantity, **errors):
    return Simulation(Scenario.model_validate({
        "name": "toy", "description": "toy", "seed": 3,
        "rsus": {"units": [
            {"id": "a", "position": [0.0, -15.0, 4.0]},
            {"id": "b", "position": [30.0, 20.0, 4.0]},
            {"id": "c", "position": [60.0, -20.0, 4.0]},
        ]},
        "measurement": {
            "quantities": [quantity], "nearest": 3, "errors": {"model": "fixed", **errors},
        },
        "devices": [{
            "route": {"kind": "waypoints", "points": [[0.0, 0.0], [60.0, 0.0]]},
            "speed_mps": 7.5, "beacon_interval_s": 0.1, "initial_pose_sd_m": 5.0,
        }],
    }))


def drive(simulation, heard=lambda tracker, measured: measured, **settings):
    tracker = Tracker(TrackerConfig(
        hold_s=0.0, require_initial_pose=True, initial_speed_sd_mps=8.0, **settings,
    ))
    for info in simulation.rsus:
        tracker.add_rsu(info)
    truth, outputs = {}, []
    for event in simulation.events():
        if isinstance(event, Odometry):
            truth[event.stamp_ns] = event.position
        if isinstance(event, InitialPose):
            tracker.add(event)
        if isinstance(event, Beacon):
            for m in heard(tracker, simulation.measure(event)):
                assert tracker.add(m) is None, m
        outputs += tracker.process()
    outputs += tracker.flush()
    told = [o.odometry for o in outputs if o.odometry is not None]
    return {
        "positions": [list(o.position[:2]) for o in told],
        "errors": [float(np.linalg.norm((o.position - truth[o.stamp_ns])[:2])) for o in told],
        "sds": [float(np.sqrt(np.diag(o.pose_cov)[:2].sum())) for o in told],
        "nis": sum(o.status.nis for o in outputs),
        "dof": sum(o.status.nis_dof for o in outputs),
        "modes": max(len(o.status.modes) for o in outputs),
    }
"""
"""For ``run``: ``drive`` follows a device along a ``street`` with three RSUs."""


def code_of(page: str) -> list[str]:
    """The Python blocks of a page, in order."""
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def copy_of_library(root: Path) -> Path:
    """The package, copied into the folder ``root``."""
    package = root / "netpos"
    here = Path(netpos.__file__).parent
    shutil.copytree(here, package, ignore=shutil.ignore_patterns("__pycache__"))
    return package


def add_entry(room: Path, name: str, module: str, line: str) -> None:
    """Write ``module`` as ``name`` into a room of the estimator and put ``line``, an import and an
    entry, into its table: one line each."""
    (room / f"{name}.py").write_text(module, encoding="utf-8")
    table = room / "table.py"
    before = table.read_text(encoding="utf-8")
    importing, entry = (text.strip() for text in line.split("\n\n"))
    first = re.search(r"^from netpos", before, re.MULTILINE)
    assert first is not None
    after = before[: first.start()] + importing + "\n" + before[first.start() :]
    after = re.sub(
        r"^(\w+: tuple\[\w+, \.\.\.\] = \(\n(?:    .*\n)*)",
        rf"\g<1>    {entry}\n",
        after,
        flags=re.MULTILINE,
    )
    assert len(after.splitlines()) == len(before.splitlines()) + 2
    table.write_text(after, encoding="utf-8")


def run(library: Path, *arguments: str) -> str:
    """Output of Python on the copy in ``library``, without the compiler."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    paths = [str(library), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    command = [sys.executable, "-W", "ignore", *arguments]
    result = subprocess.run(
        command, capture_output=True, text=True, env=environment, check=False, cwd=library
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def run_tests(library: Path, tests: Path, chosen: str) -> int:
    """How many of the ``chosen`` tests of a file pass on the copy; none may fail."""
    root = DOCS.parent
    output = run(
        library,
        "-m",
        "pytest",
        "-q",
        f"--rootdir={root}",
        f"-c={root}/pyproject.toml",
        "-k",
        chosen,
        str(tests),
    )
    return int(re.findall(r"(\d+) passed", output)[0])
