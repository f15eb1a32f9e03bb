"""The live node, measured from outside by ``bench_probe``, a process that speaks ROS."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import statistics
import subprocess
from pathlib import Path
from typing import Any

from netpos.bench.common import (
    Result,
    Unavailable,
    growth_exponent,
    within,
)
from netpos.bench.domains import claim_domain

_TIMEOUT_S = 150.0
_STOP_S = 15.0
_PERIOD_S = 0.1
_READY_S = 2.0
_MEMORY_MB = 250.0
_FLOOD_HZ = 20_000


def executable(package: str, name: str) -> Path:
    """A node's executable, as ``ros2 run`` finds it.

    Raises ``Unavailable`` where ROS is not sourced or the workspace is not built.
    """
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix) / "lib" / package / name
        if prefix and os.access(path, os.X_OK):
            return path
    raise Unavailable(
        f"no executable {package}/{name}: source env.sh after make setup to measure the live node."
    )


def surroundings(domain: int) -> dict[str, str]:
    """Environment of the processes: a domain on this host."""
    environment = {k: v for k, v in os.environ.items() if k != "ROS_LOCALHOST_ONLY"}
    return {
        **environment,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }


def probe(*arguments: str, timeout_s: float | None = None) -> dict[str, Any]:
    """Figures of one run of the probe, which starts and ends the nodes itself.

    Raises ``Unavailable`` with its last words where it fails.
    """
    tracker = executable("ekf_tracker", "ekf_tracker")
    command = [str(executable("netpos_bringup", "bench_probe")), "--tracker", str(tracker)]
    with (
        claim_domain() as domain,
        subprocess.Popen(
            [*command, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=surroundings(domain),
            start_new_session=True,
        ) as process,
    ):
        try:
            out, error = process.communicate(timeout=timeout_s or _TIMEOUT_S)
        except BaseException as reason:
            _end(process)
            if isinstance(reason, subprocess.TimeoutExpired):
                raise Unavailable(
                    f"the probe did not end within {timeout_s or _TIMEOUT_S:g} s."
                ) from None
            raise
    if process.returncode:
        words = error.strip().splitlines() or [f"exit code {process.returncode}"]
        raise Unavailable(f"the probe failed: {words[-1]}")
    figures: dict[str, Any] = json.loads(out)
    return figures


def _end(process: subprocess.Popen[str]) -> None:
    """Wait until it has ended its nodes, then kill the rest of its group."""
    process.send_signal(signal.SIGTERM)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_STOP_S)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def latency_rows(quick: bool) -> list[Result]:
    """Measurement to odometry, the tracker and a bare relay in turns."""
    figures = probe("latency", "--epochs", "200" if quick else "1000")
    ours, theirs = figures["tracker"], figures["relay"]
    note = f"{figures['epochs']} epochs; unanswered: {ours['lost']}, relay {theirs['lost']}."
    what, relay = "latency, measurement to odometry", "a relay node"
    return [
        within(f"{what}, median", ours["median_s"], relay, theirs["median_s"], 2.0, note=note),
        within(f"{what}, 99th percentile", ours["p99_s"], relay, theirs["p99_s"], 4.0, note=note),
    ]


def load_rows(quick: bool) -> list[Result]:
    """A hundred devices at 10 Hz in real time, and how cost grows with devices."""
    seconds = {25: 2.0, 50: 2.0, 100: 3.0} if quick else {25: 6.0, 50: 6.0, 100: 20.0}
    runs = {
        count: probe("load", "--devices", str(count), "--seconds", str(duration))
        for count, duration in seconds.items()
    }
    most = runs[max(runs)]
    costs = [run["cpu_traffic"] for run in runs.values()]
    return [
        *_load(most),
        within(
            f"processor time against devices ({', '.join(map(str, runs))}), exponent",
            growth_exponent(runs, costs),
            "linear",
            1.0,
            1.1,
            unit="",
            note=f"{', '.join(f'{c:.2f}' for c in costs)} s/s beside idling.",
        ),
    ]


def _load(run: dict[str, Any]) -> list[Result]:
    what = f"{run['devices']} devices at 10 Hz, two RSUs each, {run['seconds']:g} s"
    unhandled = run["sent"] - run["handled"]
    unanswered = run["epochs"] - run["odometry"]
    lags = f"median {1e3 * run['lag_median_s']:.1f} ms, largest {1e3 * run['lag_max_s']:.1f} ms"
    return [
        within(
            f"{what}: messages lost",
            unhandled + unanswered,
            "messages sent",
            run["sent"],
            0.0,
            unit="messages",
            note=f"Measurements not handled: {unhandled}; epochs without odometry: {unanswered}.",
        ),
        _lag_row(
            what,
            run,
            f"{lags}. The probe used {run['cpu_probe']:.2f} s/s and was at most "
            f"{1e3 * run['probe_late_s']:.1f} ms late.",
        ),
        _processor_row(what, run, f"{run['cpu_idle']:.3f} s/s of it when nothing comes."),
        within(
            f"{what}: resident memory",
            run["memory_mb"],
            "limit",
            _MEMORY_MB,
            1.0,
            unit="MB",
        ),
    ]


def flood_rows(quick: bool) -> list[Result]:
    """Ten devices while one RSU sends 20,000 messages a second, beside the same without it."""
    seconds = "4" if quick else "20"
    quiet, run = (
        probe("flood", "--rate", f"{rate_hz}", "--seconds", seconds) for rate_hz in (0, _FLOOD_HZ)
    )
    what = f"{run['devices']} devices beside {_FLOOD_HZ} messages/s of one RSU"
    return [
        within(
            f"{what}: epochs without odometry",
            run["epochs"] - run["odometry"],
            "epochs",
            run["epochs"],
            0.0,
            unit="epochs",
            note=f"{run['refused_of_flood']} messages of the flood refused and counted.",
        ),
        _lag_row(
            what,
            run,
            f"Without the flood {1e3 * quiet['lag_p99_s']:.1f} ms; median "
            f"{1e3 * run['lag_median_s']:.1f} ms, without {1e3 * quiet['lag_median_s']:.1f} ms.",
        ),
        _processor_row(what, run, f"Without the flood {_processor_s(quiet):.3f} s/s."),
    ]


def _lag_row(what: str, run: dict[str, Any], note: str) -> Result:
    lag_s = run["lag_p99_s"]
    name = f"{what}: lag of odometry, 99th percentile"
    return within(name, lag_s, "one period", _PERIOD_S, 1.0, note=note)


def _processor_s(run: dict[str, Any]) -> float:
    """Processor time of the tracker per second."""
    return float(run["cpu_idle"] + run["cpu_traffic"])


def _processor_row(what: str, run: dict[str, Any], note: str) -> Result:
    name = f"{what}: processor time of the tracker"
    return within(name, _processor_s(run), "one core", 1.0, 1.0, unit="s/s", note=note)


def ready_rows(quick: bool) -> list[Result]:
    """From the start of the process, kernels cached, until it takes measurements and to its first
    odometry; and memory then."""
    figures = probe("ready", "--starts", "1" if quick else "5")

    def row(until: str, seconds: list[float], note: str) -> Result:
        each = ", ".join(f"{s:.2f}" for s in seconds)
        what = f"start of the node {until}, median"
        took = statistics.median(seconds)
        return within(what, took, "limit", _READY_S, 1.0, note=f"Each start: {each} s; {note}.")

    processor_s = min(figures["cpu_s"])
    return [
        row(
            "until it takes measurements",
            figures["ready_s"],
            f"{processor_s:.2f} s of processor time",
        ),
        row(
            "to its first odometry",
            figures["odometry_s"],
            "with the discovery of two processes",
        ),
        within(
            "resident memory of the node, one device",
            figures["memory_mb"],
            "limit",
            _MEMORY_MB,
            1.0,
            unit="MB",
        ),
    ]
