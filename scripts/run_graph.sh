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
plan run "$scenario" "$bag" "$rate" "$seed"
start_up_stage recorder # first of all: what is published before a recorder is up is lost
start_trackers "$@"
start_up_stage rsus
start_up_stage walkers # who walks is dead-reckoned
pdr_nodes=("${staged[@]}")
start_stage source
tell_progress vue_sim simulated
await vue_sim || give_up
sleep 1 # the last messages are under way
[ "${#pdr_nodes[@]}" = 0 ] || stop "${pdr_nodes[@]}"
stop rsu_sensor
stop_trackers
sleep 0.5 # the tracker's last estimates, given out as it stopped
stop netpos_record
graph_end
