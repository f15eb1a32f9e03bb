# shellcheck shell=bash
# Functions of the scripts that run a graph: start nodes with `ros2 run`, wait for them, stop them, tell which failed.
# A script sources this file, calls graph_begin NAME, then the functions below, then graph_end.

# Job control gives every node a process group of its own with an ordinary SIGINT: a Ctrl-C reaches this script alone,
# which then stops the nodes in order.
set -m

stop_s=20 # how long a node may take to finish after SIGINT

graph_begin() { # NAME: a quiet domain of its own, and a fresh folder for the logs
  export ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-$((1 + $$ % 101))}
  export ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
  export PYTHONUNBUFFERED=1
  graph_logs=$NETPOS_ROOT/out/logs/$1
  rm -rf "$graph_logs"
  mkdir -p "$graph_logs"
  declare -gA pid_of=()
  failed=()
  trap graph_abandon EXIT
  trap 'exit 130' INT
  trap 'exit 143' TERM HUP
}

start() { # NAME PACKAGE EXECUTABLE [ARGUMENT...]
  local name=$1
  shift
  ros2 run "$@" </dev/null >"$graph_logs/$name.log" 2>&1 &
  pid_of[$name]=$!
}

tell_progress() { # NAME WORD: what it logs of its progress, as it goes
  tail --lines=+1 --follow --pid="${pid_of[$1]}" "$graph_logs/$1.log" | sed --unbuffered --quiet "s/.*\($2 .*\)/netpos: \1/p" >&2 &
}

start_up() { # NAME...: wait until the nodes of these names are in the graph
  python "$NETPOS_ROOT/scripts/wait_for_nodes.py" "$@" &
  pid_of[wait]=$!
  await wait && return
  [ "${#failed[@]}" -gt 0 ] || failed=("$@")
  give_up
}

await() { # NAME: wait until it ends; false when it, or another node before it, failed
  local ended code name
  while true; do
    code=0
    wait -n -p ended "${pid_of[@]}" || code=$?
    for name in "${!pid_of[@]}"; do
      [ "${pid_of[$name]}" != "$ended" ] || break
    done
    forget "$name" "$code"
    if [ "$name" = "$1" ]; then return "$code"; fi
    if [ "$code" = 0 ]; then
      echo "netpos: $name ended before the run did" >&2
      failed+=("$name")
    fi
    return 1
  done
}

forget() { # NAME CODE: it has ended
  unset "pid_of[$1]"
  if [ "$2" != 0 ] && [ "$1" != wait ]; then
    failed+=("$1")
    echo "netpos: $1 failed with exit code $2" >&2
  fi
}

stop() { # NAME...: SIGINT and wait; one that does not end is killed and counts as failed
  local name pid code tries signal
  for name in "$@"; do
    pid=${pid_of[$name]:-}
    [ -n "$pid" ] || continue
    if [ "$name" = wait ]; then signal=TERM; else signal=INT; fi
    kill "-$signal" -- "-$pid" 2>/dev/null || true
    for ((tries = stop_s * 20; tries > 0; tries--)); do
      kill -0 "$pid" 2>/dev/null || break
      sleep 0.05
    done
    kill -KILL -- "-$pid" 2>/dev/null || true
    code=0
    wait "$pid" || code=$?
    forget "$name" "$code"
  done
}

give_up() { # stop everything that runs, then report
  stop "${!pid_of[@]}"
  graph_end
  exit 1
}

graph_end() { # exit 1 naming the nodes that failed, with the end of their logs
  trap - EXIT
  [ "${#failed[@]}" -gt 0 ] || return 0
  local name
  for name in "${failed[@]}"; do
    echo "---- the end of $graph_logs/$name.log" >&2
    tail -n 20 "$graph_logs/$name.log" >&2
  done
  exit 1
}

graph_abandon() { # the script ends early (Ctrl-C, an error): leave nothing running
  trap - EXIT
  trap '' INT TERM HUP
  stop_s=5
  stop "${!pid_of[@]}" 2>/dev/null
}

plan() { # KIND ARGUMENT...: the nodes of a graph, as netpos.scenario.graph describes them
  nodes=$(python "$NETPOS_ROOT/scripts/graph_plan.py" "$@") || give_up
}

start_stage() { # STAGE [ARGUMENT...]: start the nodes of this stage of the plan; their names are then in $staged
  local words stage=$1
  shift
  staged=()
  while IFS=$'\t' read -r -a words; do
    [ "${words[0]}" = "$stage" ] || continue
    start "${words[@]:1}" "$@"
    staged+=("${words[1]}")
  done <<<"$nodes"
}

start_up_stage() { # STAGE [ARGUMENT...]: the same, and wait until they are in the graph
  start_stage "$@"
  [ "${#staged[@]}" = 0 ] || start_up "${staged[@]}"
}

start_trackers() { # [ARGUMENT...]: those of the plan, and the fusion of their tracks; waits
  start_up_stage fusion
  start_up_stage trackers "$@"
  trackers=("${staged[@]}")
}

stop_trackers() { # first those whose last tracks the fusion waits for
  stop "${trackers[@]}"
  sleep 0.5
  stop track_fusion
}
