"""Teams of other software: PX4 autopilots, and ROS 2."""
