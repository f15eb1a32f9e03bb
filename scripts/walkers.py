"""Print the devices of a scenario that a person walks with: python scripts/walkers.py SCENARIO."""

from __future__ import annotations

import sys

from netpos.scenario import ScenarioError, load_scenario


def main() -> None:
    """One name a line; exit 2 for a scenario that cannot be used."""
    try:
        scenario = load_scenario(sys.argv[1])
    except ScenarioError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print("\n".join(scenario.walkers))


if __name__ == "__main__":
    main()
