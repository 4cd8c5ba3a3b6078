"""The compensator at run time, without ROS: stamps, models that take over, resets, ramps, feedback, trajectories."""
