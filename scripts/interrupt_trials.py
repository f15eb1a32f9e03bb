"""Ctrl-C at random moments of ``netpos reproduce``: how it ends, counted.

python scripts/interrupt_trials.py --trials 50
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter

# A shell's background jobs, and so their children, ignore SIGINT.
MAIN = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from netpos.cli.main import main; main()"
)
SPAN_S = (0.6, 6.0)


def trial(workers: int, after_s: float) -> str:
    """Exit status, and whether there was more than one line about it."""
    command = [sys.executable, "-c", MAIN, "reproduce", "fokin2020", "--workers", str(workers)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        time.sleep(after_s)
        os.killpg(process.pid, signal.SIGINT)
        try:
            out, err = process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return "never ended"
    return f"status {process.returncode}" + (", traceback" if "Traceback" in out + err else "")


def main() -> None:
    """One worker and two in turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    rng = random.Random(asked.seed)
    ends = Counter(trial(1 + k % 2, rng.uniform(*SPAN_S)) for k in range(asked.trials))
    for end, count in ends.most_common():
        print(f"{count}: {end}")


if __name__ == "__main__":
    main()
