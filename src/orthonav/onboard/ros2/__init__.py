"""`orthonav fly --ros2`: a node of a ROS 2 graph, by `rclpy`.

Data flow: `node` receives raw samples and decodes them by the definitions of `rosbags` -> `reader`
makes images with their telemetry -> the runner -> the gate -> `publisher` makes messages -> `node`
sends them. It also reads the parameters and resolves names, by `rclpy`.
"""
