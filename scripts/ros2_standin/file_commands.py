"""`ros2 interface list | show` and `ros2 bag info`: what is read from files, without the graph."""

from __future__ import annotations

import argparse
import os
from datetime import datetime
from pathlib import Path
from typing import Any

from shared import CommandError

_KINDS = ("msg", "srv", "action")
_TITLES = {"msg": "Messages", "srv": "Services", "action": "Actions"}


def add_parsers(commands: Any) -> None:
    """Declare `ros2 interface ...` and `ros2 bag info`."""
    interface = commands.add_parser("interface").add_subparsers(dest="verb", required=True)
    show = interface.add_parser("show")
    show.add_argument("type", help="package/msg/Type")
    show.set_defaults(read=show_interface)
    listing = interface.add_parser("list")
    for kind in _KINDS:
        listing.add_argument(f"-{kind[0]}", f"--only-{kind}s", dest=kind, action="store_true")
    listing.set_defaults(read=list_interfaces)
    bag = commands.add_parser("bag").add_subparsers(dest="verb", required=True)
    info = bag.add_parser("info")
    info.add_argument("bag", type=Path)
    info.set_defaults(read=show_bag)


def _shares() -> list[Path]:
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(prefix) / "share" for prefix in prefixes if prefix]


def show_interface(arguments: argparse.Namespace) -> int:
    """Print the definition file of an interface."""
    package, _, rest = arguments.type.partition("/")
    kind, _, name = rest.rpartition("/")
    wanted = [kind] if kind else list(_KINDS)
    for share in _shares():
        for one in wanted:
            path = share / package / one / f"{name}.{one}"
            if path.is_file():
                print(path.read_text(encoding="utf-8"), end="")
                return 0
    if not any((share / package).is_dir() for share in _shares()):
        raise CommandError(f"unknown package {package!r} in {arguments.type!r}")
    raise CommandError(f"no interface {arguments.type!r}, expected package/msg/Type")


def list_interfaces(arguments: argparse.Namespace) -> int:
    """Print the names of all interfaces."""
    chosen = [kind for kind in _KINDS if getattr(arguments, kind)] or list(_KINDS)
    for kind in chosen:
        print(f"{_TITLES[kind]}:")
        found = {
            f"{path.parent.parent.name}/{kind}/{path.stem}"
            for share in _shares()
            for path in share.glob(f"*/{kind}/*.{kind}")
        }
        for name in sorted(found):
            print(f"    {name}")
    return 0


def show_bag(arguments: argparse.Namespace) -> int:
    """Print what a bag holds."""
    from netpos.bags import BagError, BagReader  # noqa: PLC0415 - only this command needs it

    path = arguments.bag
    try:
        with BagReader(path) as bag:
            _print_bag(path, bag)
    except (BagError, FileNotFoundError) as error:
        raise CommandError(str(error)) from None
    return 0


def _print_bag(path: Path, bag: Any) -> None:
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    size = sum(file.stat().st_size for file in files)
    begin, end = bag.start_ns, bag.end_ns
    print(f"Files:             {', '.join(file.name for file in files)}")
    print(f"Bag size:          {size / 2**20:.1f} MiB\nStorage id:        mcap")
    print(f"Duration:          {(end - begin) * 1e-9:.9f}s")
    for name, ns in (("Start:", begin), ("End:", end)):
        print(f"{name:<19}{datetime.fromtimestamp(ns * 1e-9)} ({ns * 1e-9:.9f})")
    print(f"Messages:          {sum(topic.count for topic in bag.topics.values())}")
    lead = "Topic information: "
    for name, topic in sorted(bag.topics.items()):
        print(
            f"{lead}Topic: {name} | Type: {topic.type_name} | Count: {topic.count} |"
            " Serialization Format: cdr"
        )
        lead = " " * len(lead)
