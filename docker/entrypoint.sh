#!/usr/bin/env bash
# Run a command with ROS 2 and netpos on PATH.
set -e
# shellcheck source=/dev/null
. /opt/ros/jazzy/setup.bash
# shellcheck source=env.sh
. /netpos/env.sh
exec "$@"
