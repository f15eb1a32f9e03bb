"""Print the networks of a scenario or bag whose tracks are fused: python scripts/networks.py
SOURCE."""

from __future__ import annotations

import sys

from netpos.scenario.settings import settings_from


def main() -> None:
    """One name a line, none where one tracker takes all; exit 2 for a source that cannot be
    used."""
    try:
        networks = settings_from(sys.argv[1]).networks
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print("\n".join(networks))


if __name__ == "__main__":
    main()
