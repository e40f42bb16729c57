"""The ROS package around `orthonav fly --ros2`."""

from setuptools import setup

NAME = "orthonav_ros"

setup(
    name=NAME,
    version="0.1.0",
    description="Position fixes from a downward camera and an orthophoto, as a ROS 2 node",
    license="Apache-2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/orthonav.launch.py"]),
        (f"share/{NAME}/config", ["config/params.yaml", "config/ekf.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"console_scripts": ["orthonav_node = orthonav_ros.node:main"]},
)
