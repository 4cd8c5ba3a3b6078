#!/bin/sh
# Good guess: a subscription whose callback takes the message and its MessageInfo works in every executor.
# Really: SingleThreadedExecutor gives a dictionary with publication_sequence_number, by which lost samples are counted;
# the events executor leaves spin_once with SystemError, and the callback is never called.
# rclpy 7.1.6 (ROS 2 Jazzy, wheels of PyPI), rclpy/experimental/events_executor.py; docs of Node.create_subscription.
# Met by: who writes a node beside a stage that counts lost samples, and moves it to the events executor to be faster.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check ros-jazzy-rclpy==7.1.6 ros-jazzy-common-interfaces==5.3.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-98}" ROS_LOG_DIR="$folder/log"
cd "$folder"
venv/bin/python - <<'PY'
import sys
import time
from importlib.metadata import version

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from std_msgs.msg import Float64

rclpy.init()
found = {}
for kind in (SingleThreadedExecutor, EventsExecutor):
    node, heard = rclpy.create_node("heard"), []
    node.create_subscription(Float64, "volts", lambda message, info: heard.append(info), 10)
    publisher = node.create_publisher(Float64, "volts", 10)
    executor = kind()
    executor.add_node(node)
    found[kind.__name__] = "nothing came"
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        publisher.publish(Float64(data=1.0))
        try:
            executor.spin_once(timeout_sec=0.1)
        except SystemError as error:
            found[kind.__name__] = f"SystemError: {error}"
            break
        if heard:
            found[kind.__name__] = f"sequence number {heard[0]['publication_sequence_number']}"
            break
    node.destroy_node()
print(f"rclpy {version('ros-rclpy')}")
for name, what in found.items():
    print(f"{name}: {what}")
if not found["SingleThreadedExecutor"].startswith("sequence") or not found["EventsExecutor"].startswith("SystemError"):
    sys.exit("the behaviour has changed")
PY
