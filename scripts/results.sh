#!/usr/bin/env bash
# Measure the figures of README.md and docs/results anew and render them: scripts/results.sh [--runs N] [PART]...
# Parts: fokin2020 petukhov dvornikov2017 deng2022 learned error_grid random_networks real_data fewer_rsus halved scenarios walking speed; without any, all of them.
set -euo pipefail

usage() { sed -n '2,3s/^# //p' "${BASH_SOURCE[0]}" >&2; exit 2; }
papers=(fokin2020 petukhov dvornikov2017 deng2022)
every=("${papers[@]}" learned error_grid random_networks real_data fewer_rsus halved scenarios walking speed)
runs=() parts=()
while [ $# -gt 0 ]; do
  case $1 in
    --runs) [ $# -ge 2 ] || usage; runs=(--runs "$2"); shift 2 ;;
    *) [[ " ${every[*]} " == *" $1 "* ]] || usage; parts+=("$1"); shift ;;
  esac
done
[ ${#parts[@]} -gt 0 ] || parts=("${every[@]}")
# shellcheck source=env.sh
[ -n "${NETPOS_ROOT:-}" ] || { set +u; . "$(dirname "${BASH_SOURCE[0]}")/../env.sh"; set -u; }
cd "$NETPOS_ROOT"
recorded=docs/results/recorded
pictures=docs/results/pictures
data=${NETPOS_DATA:-$NETPOS_ROOT/../shared/data}
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
mkdir -p "$recorded" "$pictures"

paper() { # PAPER: its rows, and those of its pictures that the pages show
  netpos reproduce "$1" "${runs[@]}" --json "$recorded/$1.json" --out "$scratch/$1"
  for picture in "$scratch/$1"/*.png; do
    shown="$pictures/$1_$(basename "$picture")"
    ! grep -qrF "$(basename "$shown")" --include='*.md' README.md docs/results || cp "$picture" "$shown"
  done
}

real_data() {
  python scripts/real_data.py --data "$data" --json "$recorded/real_data.json" --out "$scratch/real_data"
}

scenarios() { # one run of each scenario, as a user runs it
  for file in ros2_ws/src/netpos_bringup/scenarios/*.yaml; do
    name=$(basename "$file" .yaml)
    netpos run "$name" --offline --bag "$scratch/$name" >"$scratch/$name.log"
    netpos evaluate "$scratch/$name" --json "$scratch/scenarios/$name.json" >"$scratch/$name.log"
  done
  netpos evaluate "$scratch/metis_madrid" --map "$pictures/metis_map.png" --bounds "$pictures/metis_bounds.png" >"$scratch/metis.log"
  python - "$scratch/scenarios" "$recorded/scenarios.json" <<'PYTHON'
import json
import sys
from pathlib import Path

rows = [
    {"name": path.stem if len(vues) == 1 else f"{path.stem}, {vue}", **figures}
    for path in sorted(Path(sys.argv[1]).glob("*.json"))
    for vues in [json.loads(path.read_text())["vues"]]
    for vue, figures in vues.items()
]
Path(sys.argv[2]).write_text(json.dumps({"rows": rows}, indent=2) + "\n")
PYTHON
}

for part in "${parts[@]}"; do
  echo "netpos results: $part"
  case $part in
    learned) python scripts/learned_papers.py --json "$recorded/learned.json" ;;
    error_grid) python scripts/error_grid.py --json "$recorded/error_grid.json" ;;
    random_networks) python scripts/random_networks.py --json "$recorded/random_networks.json" ;;
    real_data) real_data ;;
    fewer_rsus) python scripts/fewer_rsus.py --parts whole without from --json "$recorded/fewer_rsus.json" ;;
    halved) python scripts/fewer_rsus.py --parts two backwards --json "$recorded/halved.json" ;;
    scenarios) scenarios ;;
    walking) python scripts/pdr_results.py "$data" --json "$recorded/walking.json" ;;
    speed) netpos bench --json "$recorded/speed.json" ;;
    *) paper "$part" ;;
  esac
done
python scripts/render_results.py
