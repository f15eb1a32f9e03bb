"""Print the nodes of a graph, for scripts/graph.sh: python scripts/graph_plan.py KIND ARGUMENT...

KIND ARGUMENT...: run SCENARIO BAG RATE SEED | play BAG OUT_BAG RATE | tracker PARAMS BAG (each may
be empty). A line a node: stage, name, package, executable, argument..., separated by tabs.
"""

from __future__ import annotations

import sys

from netpos.scenario.graph import GraphNode, play_of, run_of, tracker_of


def planned(kind: str, *arguments: str) -> list[GraphNode]:
    """The nodes. Raises ``ValueError`` for what cannot be run."""
    match kind, arguments:
        case "run", (scenario, bag, rate, seed):
            return run_of(scenario, bag, float(rate), int(seed))
        case "play", (source, bag, rate):
            return play_of(source, bag, float(rate))
        case "tracker", (params_file, bag):
            return tracker_of(params_file, bag)
    raise ValueError(f"no graph {kind!r} of {len(arguments)} arguments")


def main() -> None:
    """Exit 2 for what cannot be run."""
    try:
        nodes = planned(*sys.argv[1:])
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    for node in nodes:
        print("\t".join([node.stage, node.name, *node.command]))


if __name__ == "__main__":
    main()
