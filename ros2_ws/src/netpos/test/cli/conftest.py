"""A small recording and a way to call the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from netpos.bags import BagWriter, codec
from netpos.cli.main import app
from netpos.messages.values import Odometry
from typer.testing import CliRunner, Result

Netpos = Callable[..., Result]


@pytest.fixture
def netpos() -> Netpos:
    """``netpos(*arguments)``: exit code, stdout and stderr of one call."""

    def call(*arguments: object) -> Result:
        return CliRunner().invoke(app, [str(argument) for argument in arguments])

    return call


def record(path: Path, *, truth: bool = True, estimates: bool = True) -> Path:
    """3 s eastwards at 1 m/s; every estimate 0.25 m too far north."""
    convert = codec()
    with BagWriter(path, metadata={"tracker": "{}"}) as bag:
        for k in range(31):
            stamp = 1_000_000_000 + k * 100_000_000
            for name, north in (("ground_truth", 0.0), ("odometry", 0.25)):
                if not (truth if name == "ground_truth" else estimates):
                    continue
                pose = Odometry(
                    stamp_ns=stamp,
                    vue_id="vue_1",
                    position=np.array([0.1 * k, north, 0.0]),
                    quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
                    linear_velocity=np.array([1.0, 0.0, 0.0]),
                )
                bag.write(f"/vue_1/{name}", convert.odometry_to_msg(pose), stamp)
    return path


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return record(tmp_path / "walk")


@pytest.fixture
def blind_bag(tmp_path: Path) -> Path:
    return record(tmp_path / "blind", truth=False)


@pytest.fixture
def raw_bag(tmp_path: Path) -> Path:
    return record(tmp_path / "raw", estimates=False)


@pytest.fixture
def cut_bag(bag: Path) -> Path:
    """The recording as a killed recorder leaves it: no metadata.yaml, the file cut off."""
    (bag / "metadata.yaml").unlink()
    file = next(bag.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return bag
