"""The real-time compensator, independent of ROS: validation, model replacement, ramps, feedback, trajectories."""
