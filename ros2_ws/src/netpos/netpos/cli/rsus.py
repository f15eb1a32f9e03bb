"""``netpos rsus``: the RSUs of a network, and what was learned of them, as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from netpos.cli.examples import epilog
from netpos.cli.progress import doing

rsus = typer.Typer(
    no_args_is_help=True, help="Keep RSUs and their learned errors as a file, and use them again."
)


@rsus.command(epilog=epilog("rsus save"))
def save(
    bag: Annotated[
        Path, typer.Argument(help="Bag with RSUs, and /rsu/learned if their errors were learned.")
    ],
    file: Annotated[Path, typer.Argument(help="YAML file to write; it must not exist.")],
) -> None:
    """Write the RSUs of a bag, and what was learned of their errors, to a file."""
    from netpos.bags.rsus_file import save_rsus  # noqa: PLC0415

    with doing("reading"):
        found = save_rsus(bag, file)
    typer.echo(f"wrote {file}: {len(found)} RSUs")


@rsus.command(epilog=epilog("rsus load"))
def load(
    file: Annotated[Path, typer.Argument(help="YAML or CSV file with RSUs.")],
    bag: Annotated[Path, typer.Argument(help="Bag to copy.")],
    out: Annotated[Path, typer.Argument(help="Bag to write; it must not exist.")],
) -> None:
    """Copy a bag, with its RSUs described as in the file. Then track it with netpos replay."""
    from netpos.bags.rsus_file import load_rsus  # noqa: PLC0415
    from netpos.cli.runs import refuse_existing  # noqa: PLC0415

    refuse_existing(out)
    with doing("copying"):
        names = load_rsus(file, bag, out)
    typer.echo(f"wrote {out}: {', '.join(names)} as in {file}")
