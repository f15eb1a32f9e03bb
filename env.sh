# source env.sh: puts ros2 and netpos on PATH (bash or zsh).
if [ -n "${BASH_SOURCE:-}" ]; then _netpos_file=${BASH_SOURCE[0]}; else _netpos_file=$0; fi
NETPOS_ROOT=$(cd "$(dirname "$_netpos_file")" && pwd)
unset _netpos_file
export NETPOS_ROOT

if [ ! -x "$NETPOS_ROOT/.venv/bin/python" ]; then
  echo "netpos: not set up yet, run: make setup" >&2
  return 1 2>/dev/null || exit 1
fi

_netpos_prepend() { # NAME FOLDER, once
  eval "_netpos_value=\${$1:-}"
  case ":$_netpos_value:" in
    *":$2:"*) ;;
    *) export "$1=$2${_netpos_value:+:$_netpos_value}" ;;
  esac
  unset _netpos_value
}

_netpos_prepend PATH "$NETPOS_ROOT/.venv/bin"
if [ "${ROS_DISTRO:-}" != jazzy ] || [ -d "$NETPOS_ROOT/.venv/share/rclpy" ]; then
  export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3
  _netpos_prepend AMENT_PREFIX_PATH "$NETPOS_ROOT/.venv"
  _netpos_prepend CMAKE_PREFIX_PATH "$NETPOS_ROOT/.venv"
  _netpos_prepend LD_LIBRARY_PATH "$NETPOS_ROOT/.venv/lib"
  command -v ros2 >/dev/null 2>&1 || _netpos_prepend PATH "$NETPOS_ROOT/scripts/ros2_standin"
fi
unset -f _netpos_prepend

if [ -f "$NETPOS_ROOT/ros2_ws/install/local_setup.bash" ] && [ -n "${BASH_VERSION:-}" ]; then
  . "$NETPOS_ROOT/ros2_ws/install/local_setup.bash"
elif [ -f "$NETPOS_ROOT/ros2_ws/install/local_setup.sh" ]; then
  COLCON_CURRENT_PREFIX="$NETPOS_ROOT/ros2_ws/install" . "$NETPOS_ROOT/ros2_ws/install/local_setup.sh"
fi
