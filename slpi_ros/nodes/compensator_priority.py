"""Real time, where the system allows it."""

import os
from pathlib import Path

from rclpy.node import Node


def ask_for_priority(node: Node, priority: int) -> None:
    """Run all threads of this process under SCHED_FIFO, those of DDS too; without the right to it say so and go on."""
    try:
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        node.get_logger().warning(f"no realtime_priority {priority}: {error}; running as any other process")
