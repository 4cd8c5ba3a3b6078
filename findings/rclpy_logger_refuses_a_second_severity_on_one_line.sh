#!/bin/sh
# Good guess: one line of code may log at a severity that depends on what it has to say: info when a limit holds, error
# when it does not.
# Really: a logger remembers the severity of each line that called it. The first other one raises ValueError, so that it
# is the line that should tell of the fault which ends the callback.
# rclpy 7.1.6 (ROS 2 Jazzy, wheels of PyPI), rclpy/impl/rcutils_logger.py, RcutilsLogger.log: "Logger severity cannot be
# changed between calls."
# Met by: who writes a node beside a stage with one function for all that it says.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check ros-jazzy-rclpy==7.1.6 ros-jazzy-common-interfaces==5.3.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3
export ROS_LOG_DIR="$folder/log"
cd "$folder"
venv/bin/python - <<'PY'
import sys
from importlib.metadata import version

import rclpy

rclpy.init()
logger = rclpy.create_node("watch").get_logger()


def tell(volts):
    (logger.error if volts > 100.0 else logger.info)(f"{volts:g} V")


print(f"rclpy {version('ros-rclpy')}")
tell(20.0)
try:
    tell(120.0)
except ValueError as error:
    print(f"the second call: ValueError: {error}")
else:
    sys.exit("the behaviour has changed: the second severity was logged")
PY
