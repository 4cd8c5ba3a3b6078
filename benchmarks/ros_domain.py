"""A ROS domain of its own for what drives simulated stages: demo, benchmarks and tests never meet a real one.

As a program it runs a command there: ``ros_domain.py COMMAND...``, once nobody else publishes voltages or states.
"""

import atexit
import fcntl
import os
import sys
import tempfile
import time
from pathlib import Path

# Domains that are safe on every system; 0 is that of everybody who has set none.
DOMAINS = range(1, 102)
# In this variable child processes find that their domain is one of these.
OWN = "SLPI_OWN_ROS_DOMAIN"
# Time to hear who is in a domain, seconds.
LISTEN = 2.0
TOPICS = ("voltage_command", "stage_state", "voltage_trajectory")


def keep_to_own_domain() -> None:
    """Let this process and its children talk on this machine only, in a domain that nobody else uses."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    given = os.environ.get("ROS_DOMAIN_ID", "0")
    if os.environ.get(OWN) != given:
        os.environ["ROS_DOMAIN_ID"] = os.environ[OWN] = str(_reserved(given))


def require_nobody_else() -> None:
    """Raise SystemExit if anybody publishes voltages or states in the domain of this process; before the first one."""
    import rclpy
    from rclpy.context import Context

    context = Context()
    context.init()
    node = rclpy.create_node("who_is_there", context=context)
    try:
        time.sleep(LISTEN)
        there = [
            f"{name} publishes {topic}"
            for name, namespace in node.get_node_names_and_namespaces()
            for topic, _ in node.get_publisher_names_and_types_by_node(name, namespace)
            if topic.rpartition("/")[2] in TOPICS
        ]
    finally:
        node.destroy_node()
        context.try_shutdown()
    if there:
        raise SystemExit(f"ROS domain {os.environ['ROS_DOMAIN_ID']}: {'; '.join(there)}; end it, or start again")


def _reserved(besides: str) -> int:
    """Take a domain, but not the one given, that no other process of this kind has until this one ends."""
    for turn in range(len(DOMAINS)):
        domain = DOMAINS[(os.getpid() + turn) % len(DOMAINS)]
        if str(domain) == besides:
            continue
        lock = open(Path(tempfile.gettempdir()) / f"slpi_ros_test_domain_{os.getuid()}_{domain}.lock", "w")  # noqa: SIM115
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            continue
        os.set_inheritable(lock.fileno(), True)
        atexit.register(lock.close)  # keeps the file, and with it the lock, until the end
        return domain
    raise SystemExit("all ROS domains of this machine are taken; wait for a test run or a benchmark to end")


if __name__ == "__main__":
    keep_to_own_domain()
    require_nobody_else()
    os.execvp(sys.argv[1], sys.argv[1:])
