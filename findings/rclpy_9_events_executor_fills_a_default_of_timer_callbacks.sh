#!/bin/sh
# Good guess: a timer calls its callback without arguments, so that a method with one that may be left out, such as
# stop(reason=None), may be one; which executor spins does not matter.
# Really: the events executor of Kilted gives a TimerInfo to each callback that could take an argument, and the reason is
# one; SingleThreadedExecutor gives it only to an argument that is annotated so. Jazzy's two executors give none.
# rclpy 9.1.2 (ROS 2 Kilted, wheels of PyPI), rclpy/experimental/events_executor.py; SingleThreadedExecutor:
# rclpy/executors.py, Executor._take_timer, check_argument_type.
# Met by: whose node beside a stage goes from Jazzy to Kilted: it ends with the error that it was not given.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check ros-kilted-rclpy==9.1.2 ros-kilted-rmw-fastrtps-cpp==9.3.3
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-98}" ROS_LOG_DIR="$folder/log"
cd "$folder"
venv/bin/python - <<'PY'
import sys
import time
from importlib.metadata import version

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor

rclpy.init()
found = {}
for kind in (SingleThreadedExecutor, EventsExecutor):
    node, reasons = rclpy.create_node("ends"), []

    def stop(reason=None, reasons=reasons):
        reasons.append(type(reason).__name__)

    node.create_timer(0.05, stop)
    executor = kind()
    executor.add_node(node)
    deadline = time.monotonic() + 20.0
    while not reasons and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.1)
    found[kind.__name__] = reasons[0] if reasons else "not called"
    node.destroy_node()
print(f"rclpy {version('ros-rclpy')}; the reason that stop(reason=None) was given")
for name, reason in found.items():
    print(f"{name}: {reason}")
if found != {"SingleThreadedExecutor": "NoneType", "EventsExecutor": "TimerInfo"}:
    sys.exit("the behaviour has changed")
PY
