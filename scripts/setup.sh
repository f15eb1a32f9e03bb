#!/usr/bin/env bash
# Install netpos into .venv and build the ROS workspace. Does nothing when both are up to date.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root=$PWD

fail() { printf 'netpos setup: %s\n' "$*" >&2; exit 1; }

container="use the container instead: docker compose -f docker/compose.yaml up"
[ "$(uname -s)-$(uname -m)" = Linux-x86_64 ] || [ "${ROS_DISTRO:-}" = jazzy ] ||
  fail "the ROS 2 wheels need x86-64 Linux, this is $(uname -s) $(uname -m); source a Jazzy installation or $container"

find_python() {
  local candidate
  for candidate in "${PYTHON:-python3}" python3.12 python3.11 python3.13; do
    if "$candidate" -c 'import sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
      printf '%s\n' "$candidate"
      return
    fi
  done
  return 1
}

python=$(find_python) || fail "needs Python 3.11, 3.12 or 3.13 with the venv module; install one (Debian: apt install python3-venv) or $container"
for compiler in cc c++; do
  command -v "$compiler" >/dev/null || fail "needs a C and C++ compiler ($compiler is missing); install one (Debian: apt install build-essential) or $container"
done

locks=(requirements.txt)
venv_flags=()
if [ "${ROS_DISTRO:-}" = jazzy ] && "$python" -c 'import rclpy' 2>/dev/null; then
  venv_flags=(--system-site-packages)
else
  locks+=(requirements-ros.txt)
fi

load_environment() { # the generated set-up files use unset variables
  set +u
  # shellcheck source=/dev/null
  . ./env.sh
  set -u
}

digest() { cat "$@" | sha256sum | cut -d' ' -f1; }

wanted="$("$python" -V) ROS=${ROS_DISTRO:-wheels} $root $(digest "${locks[@]}" scripts/setup.sh scripts/fix_wheel_cmake.py)"
if [ "$(cat .venv/.netpos-setup 2>/dev/null || true)" != "$wanted" ]; then
  echo "netpos setup: installing Python packages into .venv (about two minutes)"
  rm -rf .venv ros2_ws/build ros2_ws/install ros2_ws/log
  "$python" -m venv "${venv_flags[@]}" .venv || fail "could not create .venv; install the venv module (Debian: apt install python3-venv)"
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps "${locks[@]/#/-r}" ||
    fail "installing the locked packages failed; see the message above"
  .venv/bin/python scripts/fix_wheel_cmake.py .venv
  .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e ros2_ws/src/netpos
  printf '%s\n' "$wanted" >.venv/.netpos-setup
fi

# A symlink install follows edits of Python files; a rebuild is due when interfaces, package files or shared files change.
workspace_inputs() {
  find ros2_ws/src ros2_ws/compat -type f \
    \( -name '*.msg' -o -name CMakeLists.txt -o -name package.xml -o -name 'setup.*' -o -path '*/netpos_bringup/*' \) \
    -not -path '*/__pycache__/*' -not -path '*.egg-info/*' | sort
}
built="$(workspace_inputs | sha256sum | cut -d' ' -f1) $(workspace_inputs | xargs cat | sha256sum | cut -d' ' -f1) $wanted"
if [ "$(cat ros2_ws/install/.netpos-setup 2>/dev/null || true)" != "$built" ]; then
  echo "netpos setup: building the workspace (about a minute)"
  load_environment
  paths=(src)
  python -c 'import tf2_msgs' 2>/dev/null || paths+=(compat)
  mkdir -p ros2_ws/log
  (cd ros2_ws && colcon build --symlink-install --base-paths "${paths[@]}" \
    --cmake-args -DBUILD_TESTING=OFF "-DPython3_EXECUTABLE=$root/.venv/bin/python" >log/setup.log 2>&1) ||
    { tail -n 40 ros2_ws/log/setup.log >&2; fail "building the workspace failed; the whole log is ros2_ws/log/setup.log"; }
  load_environment
  printf '%s\n' "$built" >ros2_ws/install/.netpos-setup
fi
