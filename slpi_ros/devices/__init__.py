"""A device that is moved within limits in a thread of its own, without ROS: cycle, limits, blocks, a lost link."""
