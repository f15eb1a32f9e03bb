"""Set-up: what is refused in which sentence, what is left alone, and that its files fit.

Refusals are tried on a copy of the set-up files with a PATH that pretends to be another machine.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml

OWN = ("PATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONPATH")


def plain_environment(repository: Path, **changes: str) -> dict[str, str]:
    """The environment of a shell that has sourced nothing of this checkout."""
    environment = {
        name: ":".join(p for p in value.split(":") if not p.startswith(f"{repository}/"))
        if name in OWN
        else value
        for name, value in os.environ.items()
        if name not in ("NETPOS_ROOT", "VIRTUAL_ENV", "PYTHON", "ROS_DISTRO", "CC", "CXX")
    }
    return environment | changes


def shell(
    folder: Path, script: str, environment: dict[str, str]
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", script],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def pretend(folder: Path, name: str, text: str) -> None:
    """Put a command of this name in the folder."""
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(f"#!/bin/sh\n{text}\n")
    (folder / name).chmod(0o755)


@pytest.fixture
def copy(repository: Path, tmp_path: Path) -> Path:
    """A checkout with the set-up files alone, never set up."""
    folder = tmp_path / "checkout"
    (folder / "ros2_ws" / "src").mkdir(parents=True)
    (folder / "ros2_ws" / "compat").mkdir()
    (folder / "scripts").mkdir()
    for name in ("requirements.txt", "requirements-ros.txt", "env.sh"):
        shutil.copy(repository / name, folder / name)
    for name in ("setup.sh", "fix_wheel_cmake.py"):
        shutil.copy(repository / "scripts" / name, folder / "scripts" / name)
    return folder


def refusal(copy: Path, environment: dict[str, str]) -> str:
    """Run set-up, which must refuse without touching anything, and return its one sentence."""
    result = shell(copy, "scripts/setup.sh", environment)
    assert result.returncode == 1, result.stderr
    assert not (copy / ".venv").exists()
    (line,) = result.stderr.splitlines()
    assert line.startswith("netpos setup: ")
    assert "docker compose" in line  # the remedy that always works
    return line


@pytest.mark.parametrize(("system", "machine"), [("Linux", "aarch64"), ("Darwin", "x86_64")])
def test_other_platforms_are_refused(
    copy: Path, repository: Path, system: str, machine: str
) -> None:
    fake = copy.parent / "fake"
    pretend(fake, "uname", f'[ "$1" = -s ] && echo {system} || echo {machine}')
    environment = plain_environment(repository)
    environment["PATH"] = f"{fake}:{environment['PATH']}"
    assert f"{system} {machine}" in refusal(copy, environment)


def test_other_python_is_refused(copy: Path, repository: Path) -> None:
    fake = copy.parent / "fake"
    pretend(fake, "python3.9", "exit 1")
    line = refusal(copy, plain_environment(repository, PYTHON=str(fake / "python3.9")))
    assert "Python 3.11, 3.12 or 3.13" in line
    assert "python3.9" in line


@pytest.mark.parametrize("variable", ["CC", "CXX"])
def test_missing_compiler_is_named(copy: Path, repository: Path, variable: str) -> None:
    line = refusal(copy, plain_environment(repository, **{variable: "no-such-compiler"}))
    assert "no-such-compiler is missing" in line


def test_other_ros_is_refused(copy: Path, repository: Path) -> None:
    prefix = copy.parent / "humble"
    (prefix / "share" / "rclpy").mkdir(parents=True)
    environment = plain_environment(repository, ROS_DISTRO="humble", AMENT_PREFIX_PATH=str(prefix))
    assert "'humble' is sourced" in refusal(copy, environment)


def test_second_setup_does_nothing(repository: Path) -> None:
    """Neither in a plain shell nor after env.sh, which makes a shell look like a sourced ROS."""
    installed = repository / "ros2_ws" / "install"
    stamps = [repository / ".venv" / ".netpos-setup"]
    stamps += [installed / ".netpos-setup", installed / ".netpos-kernels"]
    before = [stamp.stat().st_mtime_ns for stamp in stamps]
    for script in ("scripts/setup.sh", ". ./env.sh && scripts/setup.sh"):
        result = shell(repository, script, plain_environment(repository))
        assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    assert [stamp.stat().st_mtime_ns for stamp in stamps] == before


def test_setup_waits_for_another(copy: Path, repository: Path) -> None:
    """While the lock is held it says so, and goes on when the holder has ended."""
    script = "(exec 8<scripts/setup.sh; flock 8; sleep 1) & sleep 0.3; CC=none scripts/setup.sh"
    result = shell(copy, script, plain_environment(repository))
    waiting, refused = result.stderr.splitlines()
    assert "waiting for it" in waiting
    assert "none is missing" in refused


def test_env_refuses_a_checkout_that_moved(copy: Path, repository: Path) -> None:
    shutil.copytree(
        repository / ".venv", copy / ".venv", ignore=lambda *_: ["lib", "share", "bin"]
    )
    result = shell(copy, ". ./env.sh && echo sourced", plain_environment(repository))
    assert result.stdout == ""
    assert f"make -C {copy} setup" in result.stderr


def test_env_twice_is_env_once(repository: Path) -> None:
    names = " ".join(f'"${name}"' for name in OWN)
    once = shell(repository, f". ./env.sh; echo {names}", plain_environment(repository))
    twice = shell(
        repository, f". ./env.sh; . ./env.sh; echo {names}", plain_environment(repository)
    )
    assert once.returncode == 0
    assert once.stdout == twice.stdout


@pytest.mark.parametrize("name", ["requirements.txt", "requirements-ros.txt"])
def test_every_requirement_is_exact(repository: Path, name: str) -> None:
    lines = (repository / name).read_text().splitlines()[1:]
    assert [x for x in lines if not re.fullmatch(r"[A-Za-z0-9_.-]+==[0-9][0-9A-Za-z.]*", x)] == []
    assert len({line.partition("==")[0].lower() for line in lines}) == len(lines)


def executables(repository: Path) -> set[tuple[str, str]]:
    """All (package, executable) that the packages' set-up files declare."""
    found = set()
    for path in (repository / "ros2_ws" / "src").glob("*/setup.py"):
        text = path.read_text()
        found |= {(path.parent.name, name) for name in re.findall(r'"(\w+) = [\w.]+:\w+"', text)}
    return found


def test_container_files_fit_the_checkout(repository: Path) -> None:
    dockerfile = (repository / "docker" / "Dockerfile").read_text()
    for line in re.findall(r"^COPY (.*)$", dockerfile, re.MULTILINE):
        for source in line.split()[:-1]:
            assert (repository / source).exists(), source
    compose = yaml.safe_load((repository / "docker" / "compose.yaml").read_text())
    services = compose["services"]
    assert set(services) == {"record", "ekf_tracker", "pdr_node", "rsu_sensor", "vue_sim"}
    for service in services.values():
        assert service["command"].split()[:2] == ["ros2", "run"]
        assert tuple(service["command"].split()[2:4]) in executables(repository)
        assert set(service.get("depends_on", [])) <= set(services)
        assert (
            repository / "docker" / service["build"]["context"] / service["build"]["dockerfile"]
        ).is_file()


def test_the_containers_of_several_networks_are_those_of_the_scenario(repository: Path) -> None:
    """A tracker for each network of two_networks and the fusion, heard by all of them."""
    services = yaml.safe_load((repository / "docker" / "networks.yaml").read_text())["services"]
    scenario = repository / "ros2_ws/src/netpos_bringup/scenarios/two_networks.yaml"
    networks = [entry["name"] for entry in yaml.safe_load(scenario.read_text())["networks"]]
    commands = {name: service["command"].split() for name, service in services.items()}
    assert all(tuple(words[2:4]) in executables(repository) for words in commands.values())
    trackers = [words for words in commands.values() if words[3] == "ekf_tracker"]
    assert sorted(w.removeprefix("network:=") for t in trackers for w in t
                  if w.startswith("network:=")) == sorted(networks)  # fmt: skip
    assert f"subscribers:={1 + len(networks)}" in commands["rsu_sensor"]
    first = yaml.safe_load((repository / "docker" / "compose.yaml").read_text())["services"]
    assert set(services["vue_sim"]["depends_on"]) <= set(first) | set(services)
    assert ["track_fusion", "track_fusion"] in [words[2:4] for words in commands.values()]


def test_packages_declare_one_another(repository: Path) -> None:
    """A package that imports another of this workspace says so in its package.xml."""
    source = repository / "ros2_ws" / "src"
    own = {path.parent.name for path in source.glob("*/package.xml")}
    for name in sorted(own):
        tree = ET.parse(source / name / "package.xml").getroot()
        declared = {element.text for element in tree if element.tag.endswith("depend")}
        imported = set()
        for path in (source / name / name).rglob("*.py"):
            imported |= set(re.findall(r"^(?:from|import) (\w+)", path.read_text(), re.MULTILINE))
        assert tree.findtext("name") == name
        assert (imported & own) - {name} - declared == set(), name
