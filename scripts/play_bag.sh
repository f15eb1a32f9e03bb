#!/usr/bin/env bash
# Replay the measurements of a bag through a live tracker and record:
# scripts/play_bag.sh BAG OUT_BAG [RATE] [-- TRACKER_ARGUMENT...]
# RATE is the speed against the recording's (default 1). Tracker parameters come from the bag, where it carries them.
set -euo pipefail

usage() { sed -n '2,4s/^# //p' "${BASH_SOURCE[0]}" >&2; exit 2; }
positional=()
while [ $# -gt 0 ] && [ "$1" != -- ]; do
  positional+=("$1")
  shift
done
[ $# -eq 0 ] || shift
[ "${#positional[@]}" -ge 2 ] && [ "${#positional[@]}" -le 3 ] || usage
bag=${positional[0]} out=${positional[1]} rate=${positional[2]:-1}
[ -e "$bag" ] || { echo "netpos: no bag at $bag" >&2; exit 1; }
[ ! -e "$out" ] || { echo "netpos: $out exists and recordings are never overwritten; choose another name" >&2; exit 1; }

# shellcheck source=env.sh
[ -n "${NETPOS_ROOT:-}" ] || { set +u; . "$(dirname "${BASH_SOURCE[0]}")/../env.sh"; set -u; }
# shellcheck source=scripts/graph.sh
. "$NETPOS_ROOT/scripts/graph.sh"

graph_begin "$(basename "$out")"
plan play "$bag" "$out" "$rate"
start_up_stage recorder
start_trackers "$@"
start_stage source
await netpos_play || give_up
sleep 1 # the last messages are under way
stop_trackers
sleep 0.5 # the tracker's last estimates, given out as it stopped
stop netpos_record
graph_end
