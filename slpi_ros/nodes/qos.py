"""Quality of service of the package's topics, as ``msg_schemas/topics.json`` lists them."""

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data

COMMANDS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
# Whoever joins late gets the last one.
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# What sensors send: the newest counts.
MEASUREMENTS = qos_profile_sensor_data
DIAGNOSTICS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
