#!/usr/bin/env bash
# Run a scenario as a live graph and record it: scripts/run_graph.sh SCENARIO BAG [RATE] [SEED] [-- TRACKER_ARGUMENT...]
# RATE is the speed against real time (default 1), SEED that of the noise (default: the scenario's).
set -euo pipefail

usage() { sed -n '2,3s/^# //p' "${BASH_SOURCE[0]}" >&2; exit 2; }
positional=()
while [ $# -gt 0 ] && [ "$1" != -- ]; do
  positional+=("$1")
  shift
done
[ $# -eq 0 ] || shift
[ "${#positional[@]}" -ge 2 ] && [ "${#positional[@]}" -le 4 ] || usage
scenario=${positional[0]} bag=${positional[1]} rate=${positional[2]:-1} seed=${positional[3]:--1}
[ ! -e "$bag" ] || { echo "netpos: $bag exists and recordings are never overwritten; choose another name" >&2; exit 1; }

# shellcheck source=env.sh
[ -n "${NETPOS_ROOT:-}" ] || { set +u; . "$(dirname "${BASH_SOURCE[0]}")/../env.sh"; set -u; }
# shellcheck source=scripts/graph.sh
. "$NETPOS_ROOT/scripts/graph.sh"

graph_begin "$(basename "$bag")"
start netpos_record netpos_bag record --output "$bag" --log-time clock
start_up netpos_record # first of all: what is published before a recorder is up is lost
start_trackers "$scenario" "$@"
start rsu_sensor rsu_sensor rsu_sensor --ros-args -p scenario:="$scenario" -p seed:="$seed" -p subscribers:="$((1 + ${#trackers[@]}))"
start_up rsu_sensor
walkers=$(python "$NETPOS_ROOT/scripts/walkers.py" "$scenario") || give_up
pdr_nodes=()
for vue in $walkers; do # who walks is dead-reckoned
  start "pdr_$vue" pdr_node pdr_node --ros-args -r __node:="pdr_$vue" -p vue:="$vue" -p scenario:="$scenario" -p subscribers:=2
  pdr_nodes+=("pdr_$vue")
done
[ "${#pdr_nodes[@]}" = 0 ] || start_up "${pdr_nodes[@]}"
start vue_sim vue_sim vue_sim --ros-args -p scenario:="$scenario" -p seed:="$seed" -p rate:="$(LC_ALL=C printf '%.6f' "$rate")" -p subscribers:=2
tell_progress vue_sim simulated
await vue_sim || give_up
sleep 1 # the last messages are under way
[ "${#pdr_nodes[@]}" = 0 ] || stop "${pdr_nodes[@]}"
stop rsu_sensor
stop_trackers
sleep 0.5 # the tracker's last estimates, given out as it stopped
stop netpos_record
graph_end
