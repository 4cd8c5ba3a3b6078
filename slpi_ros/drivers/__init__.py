"""Real amplifiers and sensors, without ROS: bare input and output; limits stand in `slpi_ros.devices.loop`."""
