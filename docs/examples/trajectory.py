"""Send a sine of 5 µm amplitude around 10 µm, one period in a second, at 1 kHz; the stage has 0.2 s to get there."""

import math
import signal

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.signals import SignalHandlerOptions
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

RATE_HZ, SAMPLES, LEAD_NS = 1000, 1001, 200_000_000

rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a traceback
node = rclpy.create_node("planner")
publisher = node.create_publisher(JointTrajectory, "desired_trajectory", 10)
ready = set()


def on_diagnostics(array: DiagnosticArray) -> None:
    """Note whether the compensator, which reports once a second, may move and does not reset the memory."""
    for status in array.status:
        values = {pair.key: pair.value for pair in status.values}
        if status.name.endswith("compensator: compensator"):
            print(status.message)
            may_move = values["state"] == "active" and not values["obstacle"]
            if may_move and "resetting" not in values["memory"]:
                ready.add("compensator")


node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
# Another subscriber of the topic, such as a recorder, does not count.
while not ready & {each.node_name for each in node.get_subscriptions_info_by_topic("desired_trajectory")}:
    rclpy.spin_once(node, timeout_sec=0.1)
trajectory = JointTrajectory(joint_names=["x"])  # stamp 0: start at once
for i in range(SAMPLES):
    position = 10e-6 - 5e-6 * math.cos(2 * math.pi * i / RATE_HZ)
    due = Duration(nanoseconds=LEAD_NS + i * 1_000_000_000 // RATE_HZ).to_msg()
    trajectory.points.append(JointTrajectoryPoint(positions=[position], time_from_start=due))
publisher.publish(trajectory)
publisher.wait_for_all_acked(Duration(seconds=5))
