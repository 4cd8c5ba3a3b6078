#!/bin/sh
# Good guess: what rclpy.serialize_message gives can be written into a bag and is read by rosbags as the message was.
# Really: where the message ends in empty arrays of doubles, as a JointState of positions alone does, it gives eight bytes
# more than the message has, of no meaning. What is published has 52 bytes, what is serialized 60; rosbags refuses the
# 60 with SerdeError ("size mismatch"), rclpy itself reads both.
# rclpy 7.1.6 (ROS 2 Jazzy, wheels of PyPI) with rmw_fastrtps_cpp 8.4.3; rosbags 0.11.9, rosbags/typesys/store.py,
# deserialize_cdr.
# Met by: who writes bags of a stage by rclpy and rosbags, and reads them by rosbags.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check ros-jazzy-rclpy==7.1.6 ros-jazzy-common-interfaces==5.3.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3 rosbags==0.11.9
cd "$folder"
venv/bin/python - <<'PY'
import sys
from importlib.metadata import version

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState

NAME = "sensor_msgs/msg/JointState"
store = get_typestore(Stores.ROS2_JAZZY)
header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](0, 0), "")
empty = np.zeros(0)
short = bytes(store.serialize_cdr(store.types[NAME](header, ["x"], np.array([1e-6]), empty, empty), NAME))
long = bytes(serialize_message(JointState(name=["x"], position=[1e-6])))
print(f"rclpy {version('ros-rclpy')}, rosbags {version('rosbags')}")
print(f"the same message: {len(long)} bytes of rclpy, {len(short)} of rosbags")
both = [list(deserialize_message(data, JointState).position) for data in (short, long)]
print(f"rclpy reads {both[0]} and {both[1]}")
try:
    store.deserialize_cdr(long, NAME)
except SerdeError as error:
    print(f"rosbags: SerdeError: {error}")
else:
    sys.exit("the behaviour has changed: rosbags reads it")
if len(long) - len(short) != 8 or both != [[1e-6], [1e-6]]:
    sys.exit("the behaviour has changed")
PY
