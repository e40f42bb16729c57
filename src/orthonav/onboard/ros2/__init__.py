"""`orthonav fly --ros2`: a node of a ROS 2 graph over DDS, without an installation of ROS.

Data flow: `node` receives raw samples -> `messages` decodes them by the definitions of `rosbags` ->
`reader` makes images with their telemetry -> the runner -> the gate -> `publisher` makes messages
-> `node` sends them. `arguments` resolves names, parameters and the domain as ROS 2 does.
"""
