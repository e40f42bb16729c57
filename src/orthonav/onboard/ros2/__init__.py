"""`orthonav fly --ros2`: a node of a ROS 2 graph, over DDS or by `rclpy` where ROS is sourced.

Data flow: a graph (`node`: over DDS or by `rclpy`) receives raw samples and decodes them by
the definitions of `rosbags` -> `reader` makes images with their telemetry -> the runner -> the gate
-> `publisher` makes messages -> the graph sends them. `arguments` resolves names, parameters and
the domain as ROS 2 does.
"""
