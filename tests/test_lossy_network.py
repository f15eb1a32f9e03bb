"""What RSUs send over a network that loses packets, or is cut: it is late, and all of it comes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

NO_HOSTS = os.geteuid() != 0 or not shutil.which("ip") or not os.access("/dev/net/tun", os.W_OK)


@pytest.mark.skipif(NO_HOSTS, reason="network namespaces need root and /dev/net/tun")
@pytest.mark.parametrize("trouble", [("--loss", "0.2"), ("--cut", "2")])
def test_nothing_is_lost_for_good(repository: Path, trouble: tuple[str, str]) -> None:
    """Five seconds of 20 messages each."""
    command = [sys.executable, str(repository / "scripts" / "lossy_network.py"), "measure"]
    result = subprocess.run(
        [*command, "--seconds", "5", *trouble],
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    if "Operation not permitted" in result.stderr:
        pytest.skip("this machine permits no network namespaces")
    assert result.returncode == 0, result.stderr
    assert "| 0 of 100 |" in result.stdout
