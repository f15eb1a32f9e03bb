# shellcheck shell=bash
# source env.sh: puts ros2 and netpos on PATH (bash or zsh).
if [ -n "${BASH_SOURCE:-}" ]; then _netpos_file=${BASH_SOURCE[0]}; else _netpos_file=$0; fi
NETPOS_ROOT=$(cd "$(dirname "$_netpos_file")" && pwd)
unset _netpos_file
export NETPOS_ROOT

if ! grep -qsx "root=$NETPOS_ROOT" "$NETPOS_ROOT/.venv/.netpos-setup"; then
  echo "netpos: not set up yet, or moved since; run: make -C $NETPOS_ROOT setup" >&2
  # shellcheck disable=SC2317 # the exit is for a script that runs this file instead of sourcing it
  return 1 2>/dev/null || exit 1
fi

_netpos_prepend() { # NAME FOLDER, once
  eval "_netpos_value=\${$1:-}"
  # shellcheck disable=SC2154 # set by the eval
  case ":$_netpos_value:" in
    *":$2:"*) ;;
    *) export "$1=$2${_netpos_value:+:$_netpos_value}" ;;
  esac
  unset _netpos_value
}

_netpos_prepend PATH "$NETPOS_ROOT/.venv/bin"
# Matrices are small: threads of the linear algebra library would only wait for each other.
export OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"
if grep -qx ros=wheels "$NETPOS_ROOT/.venv/.netpos-setup"; then
  export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3
  _netpos_prepend AMENT_PREFIX_PATH "$NETPOS_ROOT/.venv"
  _netpos_prepend CMAKE_PREFIX_PATH "$NETPOS_ROOT/.venv"
  _netpos_prepend LD_LIBRARY_PATH "$NETPOS_ROOT/.venv/lib"
  # The wheels would have every Python process find these folders and start itself anew.
  for _netpos_folder in "$NETPOS_ROOT"/.venv/lib/python3.*/site-packages/ros_*.libs; do
    _netpos_prepend LD_LIBRARY_PATH "$_netpos_folder"
  done
  unset _netpos_folder
  export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
elif [ "${ROS_DISTRO:-}" != jazzy ]; then
  echo "netpos: set up with a sourced ROS 2 Jazzy; source it first (/opt/ros/jazzy/setup.bash), or run make setup again" >&2
  # shellcheck disable=SC2317
  return 1 2>/dev/null || exit 1
fi
command -v ros2 >/dev/null 2>&1 || _netpos_prepend PATH "$NETPOS_ROOT/scripts/ros2_standin"
unset -f _netpos_prepend

if [ -f "$NETPOS_ROOT/ros2_ws/install/local_setup.bash" ] && [ -n "${BASH_VERSION:-}" ]; then
  . "$NETPOS_ROOT/ros2_ws/install/local_setup.bash"
elif [ -f "$NETPOS_ROOT/ros2_ws/install/local_setup.sh" ]; then
  COLCON_CURRENT_PREFIX="$NETPOS_ROOT/ros2_ws/install" . "$NETPOS_ROOT/ros2_ws/install/local_setup.sh"
fi
