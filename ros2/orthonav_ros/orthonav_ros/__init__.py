"""The ROS package around `orthonav fly --ros2`."""
