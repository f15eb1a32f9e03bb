#!/usr/bin/env bash
# The demonstration: run METIS Madrid as a live graph, record, score, draw; then the same with a real BLE angle-of-arrival
# recording where its data is. Everything goes to out/demo; an earlier one is moved aside.
set -euo pipefail

# shellcheck source=env.sh
[ -n "${NETPOS_ROOT:-}" ] || { set +u; . "$(dirname "${BASH_SOURCE[0]}")/../env.sh"; set -u; }
cd "$NETPOS_ROOT"
out=out/demo
if [ -e "$out" ]; then
  earlier=${out}_$(date -r "$out" +%Y%m%d_%H%M%S)
  while [ -e "$earlier" ]; do earlier=${earlier}_; done
  mv "$out" "$earlier"
  echo "netpos demo: the earlier demonstration is now $earlier"
fi
mkdir -p "$out"

score() { # BAG: table on the terminal, figures and pictures beside the bag
  netpos evaluate "$1" --json "$1.json" --map "$1.png" --errors "$1_errors.png"
}

echo "netpos demo: METIS Madrid, the live graph at ten times real time"
scripts/run_graph.sh metis_madrid "$out/metis_madrid" 10
score "$out/metis_madrid"

data=${NETPOS_DATA:-$NETPOS_ROOT/../shared/data}/ble_aoa
if [ -d "$data" ]; then
  for run in uc1_run1 uc1_run2 uc2_run1; do
    echo "netpos demo: real angles of four BLE arrays, $run, replayed through the live tracker at ten times real time"
    netpos import ble-aoa "$data" "$out/ble_${run}_input" --run "$run"
    scripts/play_bag.sh "$out/ble_${run}_input" "$out/ble_$run" 10
    score "$out/ble_$run"
  done
else
  echo "netpos demo: the real BLE recordings are not here ($data), so only the simulation was run"
fi
echo "netpos demo: recordings, figures (.json) and pictures (.png) are in $out"
