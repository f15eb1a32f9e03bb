"""``netpos scenarios``, ``netpos run``, ``netpos replay``. Heavy modules load inside the
commands, so that help is quick.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from netpos.cli.completion import complete_scenario
from netpos.cli.errors import WorkFailedError
from netpos.cli.interrupts import INTERRUPTED
from netpos.cli.progress import Bars, doing
from netpos.cli.work import ClusterAddress, Workers, worked

if TYPE_CHECKING:
    from netpos.evaluation.replays import Replays
    from netpos.scenario import Scenario
    from netpos.scenario.settings import TrackerSettings


def scenarios() -> None:
    """List the scenarios that come with netpos."""
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    from netpos.scenario import load_scenario, scenario_names  # noqa: PLC0415

    table = Table("scenario", "description")
    for name in scenario_names():
        table.add_row(name, load_scenario(name).description)
    Console().print(table)


def run(
    scenario: Annotated[
        str,
        typer.Argument(
            help="Name of a scenario, or path of a YAML file.", autocompletion=complete_scenario
        ),
    ],
    bag: Annotated[
        Path | None,
        typer.Option(help="Bag to write; it must not exist. Default: out/SCENARIO_TIME."),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(help="Speed of the live graph: 2 is twice real time. Default: 1."),
    ] = None,
    offline: Annotated[
        bool,
        typer.Option("--offline", help="Simulate and track without ROS, as fast as possible."),
    ] = False,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the noise. Default: the scenario's.")
    ] = None,
) -> None:
    """Run a scenario, as a live ROS graph or offline, and record it."""
    from netpos.scenario import load_scenario  # noqa: PLC0415

    if offline and rate is not None:
        raise ValueError("--rate is the speed of the live graph; leave it out with --offline")
    if rate is not None and not rate > 0:
        raise ValueError(f"--rate must be > 0, got {rate}")
    chosen = load_scenario(scenario, seed=seed)
    _check_tracker(scenario, chosen.tracker)
    target = bag or Path("out") / f"{chosen.name}_{datetime.now():%Y%m%d_%H%M%S}"
    refuse_existing(target)
    if offline:
        _run_offline(chosen, target)
    else:
        _run_live(scenario, target, 1.0 if rate is None else rate, chosen.seed)
    typer.echo(f"recorded {target}; score it with: netpos evaluate {target}")


def _check_tracker(scenario: str, values: Mapping[str, object]) -> None:
    """Check the tracker's parameters before the simulation starts; one line for each fault."""
    from netpos.common.parameters import FaultsError  # noqa: PLC0415
    from netpos.scenario.load import place_of  # noqa: PLC0415
    from netpos.tracking.config import TrackerConfig  # noqa: PLC0415

    try:
        TrackerConfig.from_mapping(values)
    except ValueError as together:
        faults = []
        for name, value in values.items():
            try:
                TrackerConfig.from_mapping({name: value})
            except ValueError as error:
                faults.append(f"{place_of(scenario, 'tracker', name)}: {error}")
        if not faults:  # each by itself could be
            faults = [f"{place_of(scenario, 'tracker')}: {together}"]
        raise FaultsError("\n".join(faults)) from None


def replay(
    bags: Annotated[list[Path], typer.Argument(metavar="BAG...", help="Recorded bags.")],
    out: Annotated[
        Path,
        typer.Option(
            help="Bag to write; it must not exist. For several bags: the folder to write them to."
        ),
    ],
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Parameter of the tracker; may be repeated."
        ),
    ] = None,
    smooth: Annotated[
        bool,
        typer.Option(
            "--smooth",
            help="Also estimate every epoch from all measurements, later ones included.",
        ),
    ] = False,
    parameters: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE",
            help="Take the tracker's parameters from a scenario, another bag, or 'defaults'. "
            "Default: the bag's own.",
        ),
    ] = None,
    workers: Workers = None,
    cluster: ClusterAddress = None,
) -> None:
    """Estimate again from the recorded measurements, without ROS.

    Several bags are tracked in parallel. A bag is skipped if its track exists already, made with
    the same parameters.
    """
    from netpos.scenario.settings import settings_from  # noqa: PLC0415

    overrides = dict(parse_setting(text) for text in settings or [])
    source = "" if parameters in (None, "defaults") else str(parameters)
    given = None if parameters is None else settings_from(source)
    if len(bags) > 1 or cluster is not None:
        from netpos.evaluation.replays import Replays  # noqa: PLC0415

        plan = Replays(out=out, settings=given, overrides=overrides, smooth=smooth)
        _replay_all(bags, plan, workers, cluster)
        return
    (bag,) = bags
    refuse_existing(out)
    _track(bag, out, overrides, smooth=smooth, settings=given, source=parameters or str(bag))
    if smooth:
        _tell_gain(out)
    typer.echo(f"wrote {out}")


def _replay_all(bags: list[Path], plan: Replays, workers: int | None, cluster: str | None) -> None:
    from netpos.evaluation.replays import replay_bags  # noqa: PLC0415
    from netpos.evaluation.work import Work  # noqa: PLC0415

    if plan.out.is_file() or (plan.out / "metadata.yaml").exists():
        raise NotADirectoryError(
            f"--out {plan.out}: several bags need a folder; this is a file or a bag"
        )
    bars, refused, done = Bars(), 0, 0
    try:
        with worked(), Work(1, 0, workers, bars.show, cluster=cluster, apart=True) as work:
            for bag, summary in replay_bags(bags, plan, work):
                if isinstance(summary, str):
                    refused += 1
                    typer.echo(f"netpos: {summary}", err=True)
                else:
                    done += 1
                    typer.echo(f"wrote {plan.target(bag)}: {summary.epochs} epochs")
    finally:
        bars.stop()
    there = len(bags) - done - refused
    typer.echo(f"{done} of {len(bags)} bags tracked, {there} existed already, {refused} refused")
    if refused:
        raise WorkFailedError(f"{refused} bags were not tracked")


def _tell_gain(bag: Path) -> None:
    """Print what smoothing gains over the filter, if the recording has ground truth."""
    from netpos.evaluation.smoothing import smoothing_gains  # noqa: PLC0415

    for vue, gain in smoothing_gains(bag).items():
        typer.echo(
            f"{vue}: position RMSE {gain.filter_rmse_m:.3f} m filtered, {gain.smoothed_rmse_m:.3f}"
            f" m smoothed over {gain.n} epochs: {gain.ratio:.2f} times better"
        )


def parse_setting(text: str) -> tuple[str, object]:
    """``key=value`` with the value read as YAML.

    Raises
    ------
    ValueError  there is no ``=``, no key or no YAML scalar
    """
    from netpos.common.yaml_text import YamlError, load_yaml  # noqa: PLC0415

    key, equals, value = text.partition("=")
    if not (equals and key.strip()):
        raise ValueError(f"--set takes KEY=VALUE, got {text!r}")
    try:
        return key.strip(), load_yaml(value)
    except YamlError as error:
        raise ValueError(f"--set {key}: {value!r} is not a YAML value") from error


def refuse_existing(path: Path) -> None:
    """Raise ``FileExistsError``, before the work starts, if a recording would be overwritten."""
    if path.exists():
        raise FileExistsError(
            f"{path} exists and recordings are never overwritten; choose another name"
        )


def _track(
    bag: Path,
    out: Path,
    overrides: Mapping[str, object],
    *,
    smooth: bool = False,
    settings: TrackerSettings | None = None,
    source: str,
) -> None:
    """Replay ``bag`` with parameters of ``source``, and print a summary."""
    from netpos.bags import BagReader  # noqa: PLC0415
    from netpos.scenario.replay import replay_bag  # noqa: PLC0415
    from netpos.scenario.settings import bag_settings  # noqa: PLC0415

    if settings is None:
        with BagReader(bag) as reader:
            try:
                settings = bag_settings(reader)
            except ValueError as error:
                raise ValueError(
                    f"{error}; give --parameters SCENARIO, another BAG, or 'defaults'"
                ) from error

    with doing("tracking") as tell:
        summary = replay_bag(bag, out, overrides, tell, smooth=smooth, settings=settings)
    others = ", ".join(f"{name} {value}" for name, value in summary.parameters.items())
    typer.echo(f"tracker parameters of {source}; not the default: {others or 'none'}")
    typer.echo(f"{summary.epochs} epochs")
    for fault in summary.refused_rsus.values():
        typer.echo(f"netpos: RSU refused: {fault}", err=True)
    for vue, counts in sorted(summary.rejected.items()):
        reasons = ", ".join(f"{reason} {n}" for reason, n in sorted(counts.items()) if n)
        typer.echo(f"{vue}: rejected {reasons or 'nothing'}")
    if not summary.estimates:
        typer.echo(
            f"netpos: {out} has no estimate: its measurements gave no first fix with these "
            "parameters of the tracker",
            err=True,
        )


def _run_offline(scenario: Scenario, target: Path) -> None:

    from netpos.scenario.offline import simulate_to_bag  # noqa: PLC0415

    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".netpos_") as folder:
        simulated = Path(folder) / target.name
        with doing("simulating") as tell:
            simulate_to_bag(scenario, simulated, progress=tell)
        _track(simulated, target, scenario.tracker, source=scenario.name)


def _run_live(scenario: str, target: Path, rate: float, seed: int) -> None:
    """Start the graph with scripts/run_graph.sh, which ends when the scenario has ended."""
    root = os.environ.get("NETPOS_ROOT")
    script = Path(root or ".") / "scripts" / "run_graph.sh"
    if root is None or not script.is_file():
        raise ValueError(
            "the live graph needs the netpos workspace; run: source env.sh, or use --offline"
        )
    if shutil.which("ros2") is None:
        raise ValueError(
            "ros2 is not on PATH; source env.sh or your ROS 2 installation, or use --offline"
        )
    is_path = os.sep in scenario or Path(scenario).suffix in {".yaml", ".yml"}
    name = str(Path(scenario).resolve()) if is_path else scenario
    command = [str(script), name, str(target.absolute()), f"{rate:g}", str(seed)]
    with subprocess.Popen(command) as graph:
        status = _wait(graph)
    if status == INTERRUPTED:
        raise KeyboardInterrupt
    if status != 0:
        raise WorkFailedError(f"the graph ended with status {status}; its messages are above")
    if not target.exists():
        raise WorkFailedError(f"the graph ended without a recording at {target}")
    _tell_losses(target)


def _tell_losses(bag: Path) -> None:
    """Print what the recorder missed."""
    from netpos.bags import BagReader  # noqa: PLC0415
    from netpos.evaluation.contents import lost_of  # noqa: PLC0415

    with BagReader(bag) as reader:
        for sentence in lost_of(reader):
            typer.echo(f"netpos: {sentence}", err=True)


def _wait(graph: subprocess.Popen[bytes]) -> int:
    """Exit status of the graph. Ctrl-C reaches the graph as well, which then closes its bag."""
    while True:
        try:
            return graph.wait()
        except KeyboardInterrupt:
            continue
