"""The parts of the command ``ros2`` that the tutorials use, for machines without it."""

import argparse
import importlib
import os
import sys
import time
from pathlib import Path

import rclpy
import yaml
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data

PATIENCE_S = 30.0
CHECKOUT = Path(__file__).resolve().parents[2]
PROGRAMS = CHECKOUT / os.environ.get("SLPI_INSTALL", "install") / "slpi_ros" / "lib" / "slpi_ros"


def until(node, done, what):
    end = time.monotonic() + PATIENCE_S
    while not (found := done()):
        if time.monotonic() > end:
            sys.exit(f"waited in vain for {what}")
        rclpy.spin_once(node, timeout_sec=0.02)
    return found


def message_type(name):
    package, folder, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.{folder}"), kind)


def publish(node, options):
    kind = message_type(options.type)
    message = kind(**yaml.safe_load(options.values))
    publisher = node.create_publisher(kind, options.topic, 10)
    until(node, publisher.get_subscription_count, options.topic)
    if options.once:
        publisher.publish(message)
        until(node, lambda: publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=1.0)), "delivery")
        return
    node.create_timer(1.0 / options.rate, lambda: publisher.publish(message))
    rclpy.spin(node)


def echo(node, options):
    publishers = until(node, lambda: node.get_publishers_info_by_topic(options.topic), options.topic)
    found = []
    kind = message_type(publishers[0].topic_type)
    node.create_subscription(kind, options.topic, found.append, qos_profile_sensor_data)
    until(node, lambda: found, f"a message on {options.topic}")
    print(found[0])


def set_parameter(node, options):
    client = node.create_client(SetParameters, f"{options.node}/set_parameters")
    until(node, client.service_is_ready, options.node)
    parameter = Parameter(options.name, value=yaml.safe_load(options.value)).to_parameter_msg()
    answer = client.call_async(SetParameters.Request(parameters=[parameter]))
    until(node, answer.done, "an answer")
    (result,) = answer.result().results
    if not result.successful:
        sys.exit(result.reason)


def main():
    if sys.argv[1:3] == ["run", "slpi_ros"]:
        os.execv(PROGRAMS / sys.argv[3], sys.argv[3:])
    parser = argparse.ArgumentParser(prog="ros2", allow_abbrev=False)
    groups = parser.add_subparsers(required=True)
    topic = groups.add_parser("topic").add_subparsers(required=True)
    pub = topic.add_parser("pub")
    pub.set_defaults(run=publish)
    pub.add_argument("-r", "--rate", type=float, default=1.0)
    pub.add_argument("--once", action="store_true")
    for name in ("topic", "type", "values"):
        pub.add_argument(name)
    shown = topic.add_parser("echo")
    shown.set_defaults(run=echo)
    shown.add_argument("--once", action="store_true", required=True)
    shown.add_argument("topic")
    setting = groups.add_parser("param").add_subparsers(required=True).add_parser("set")
    setting.set_defaults(run=set_parameter)
    for name in ("node", "name", "value"):
        setting.add_argument(name)
    options = parser.parse_args()
    rclpy.init()
    options.run(rclpy.create_node(f"ros2_{os.getpid()}"), options)


if __name__ == "__main__":
    main()
