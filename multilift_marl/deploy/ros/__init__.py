"""ROS 2 without ROS 2: a team's flight as messages, and bags of them; see docs/ros.md."""
