#!/usr/bin/env bash
# Run the tracker alone, for RSUs of your own, until Ctrl-C: scripts/run_tracker.sh [PARAMS.yaml] [--bag DIR] [-- TRACKER_ARGUMENT...]
# PARAMS.yaml is what `netpos params --dump PARAMS.yaml` writes. With --bag everything that is heard is recorded.
set -euo pipefail

usage() { sed -n '2,3s/^# //p' "${BASH_SOURCE[0]}" >&2; exit 2; }
params='' bag=''
while [ $# -gt 0 ] && [ "$1" != -- ]; do
  case $1 in
    --bag) [ $# -ge 2 ] || usage; bag=$2; shift 2 ;;
    -*) usage ;;
    *) [ -z "$params" ] || usage; params=$1; shift ;;
  esac
done
[ $# -eq 0 ] || shift
[ -z "$params" ] || [ -f "$params" ] || { echo "netpos: no file $params; write one with: netpos params --dump $params" >&2; exit 1; }
[ -z "$bag" ] || [ ! -e "$bag" ] || { echo "netpos: $bag exists and recordings are never overwritten; choose another name" >&2; exit 1; }

# shellcheck source=env.sh
[ -n "${NETPOS_ROOT:-}" ] || { set +u; . "$(dirname "${BASH_SOURCE[0]}")/../env.sh"; set -u; }
# shellcheck source=scripts/graph.sh
. "$NETPOS_ROOT/scripts/graph.sh"

# The tracker joins the domain of the RSUs, not one of its own.
ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-0} ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-SUBNET}
graph_begin "tracker_$$"
plan tracker "$params" "$bag"
start_up_stage recorder
start_up_stage trackers "$@"
echo "netpos: tracking in ROS domain $ROS_DOMAIN_ID; Ctrl-C ends; log: $graph_logs/ekf_tracker.log" >&2
trap 'ended=1' INT TERM HUP
ended=''
while [ -z "$ended" ] && kill -0 "${pid_of[ekf_tracker]}" 2>/dev/null; do sleep 0.2; done
if [ -z "$ended" ]; then await ekf_tracker || give_up; fi
stop ekf_tracker
sleep 0.5 # the tracker's last estimates, given out as it stopped
[ -z "$bag" ] || stop netpos_record
graph_end
