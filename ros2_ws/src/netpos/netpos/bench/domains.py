"""ROS domains of this machine, each for one user at a time."""

from __future__ import annotations

import contextlib
import fcntl
import random
import tempfile
from collections.abc import Iterator
from pathlib import Path

DOMAINS = range(1, 102)
"""Above 101 the ports of a domain may be taken by the system."""


@contextlib.contextmanager
def claim_domain() -> Iterator[int]:
    """Yield a domain id that nobody else who asks here holds, in this or any other process.

    It is the one not in use for longest: a node that was killed stays in the graph of its domain
    for seconds. Raises ``RuntimeError`` where all are in use.
    """
    for domain in sorted(random.sample(DOMAINS, len(DOMAINS)), key=_last_used_s):
        with _lock(domain).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    raise RuntimeError(f"all ROS domains {DOMAINS.start} to {DOMAINS.stop - 1} are in use")


def _lock(domain: int) -> Path:
    return Path(tempfile.gettempdir()) / f"netpos-domain-{domain}.lock"


def _last_used_s(domain: int) -> float:
    """When it was claimed last, by the clock of the file system; 0 if never."""
    try:
        return _lock(domain).stat().st_mtime
    except FileNotFoundError:
        return 0.0
