"""orthonav as a node: `ros2 launch orthonav_ros orthonav.launch.py map:=/maps/area.onav`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

CONFIG = FindPackageShare("orthonav_ros"), "config"
ARGUMENTS = {
    "map": (None, "map of the area (.onav)"),
    "namespace": ("", "namespace of the nodes"),
    "image": ("image", "topic of the camera; camera_info is beside it"),
    "imu": ("imu", "topic of the attitude"),
    "range": ("range", "topic of the distance to the ground"),
    "rel_alt": ("rel_alt", "topic of the height above home"),
    "gnss": ("gnss", "topic of a GNSS receiver, for the log"),
    "params_file": (PathJoinSubstitution([*CONFIG, "params.yaml"]), "parameters of the node"),
    "ekf": ("false", "start robot_localization with config/ekf.yaml"),
}
TOPICS = ("image", "imu", "range", "rel_alt", "gnss")


def generate_launch_description():
    """The node, restarted where it ends, and on request a filter."""
    chosen = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    orthonav = Node(
        package="orthonav_ros",
        executable="orthonav_node",
        name="orthonav",
        namespace=chosen["namespace"],
        arguments=[chosen["map"]],
        parameters=[chosen["params_file"]],
        remappings=[(topic, chosen[topic]) for topic in TOPICS],
        respawn=True,
        respawn_delay=1.0,
        output="screen",
    )
    ekf = Node(
        package="robot_localization",
        executable="ekf_node",
        name="ekf_map",
        namespace=chosen["namespace"],
        parameters=[PathJoinSubstitution([*CONFIG, "ekf.yaml"])],
        remappings=[("imu", chosen["imu"])],
        condition=IfCondition(chosen["ekf"]),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, orthonav, ekf])
