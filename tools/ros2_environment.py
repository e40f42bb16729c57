"""Environments with real ROS 2 nodes for the tests: `rclpy` of each distribution, from PyPI.

    python tools/ros2_environment.py

makes those that are missing, under `~/.cache/orthonav` (or `$XDG_CACHE_HOME/orthonav`). Where one
cannot be installed, it says so, and the tests that need it are skipped by name. They are not in the
environment of the project: a package of theirs starts every Python there twice, with the library
path of ROS, and distributions exclude each other. Wheels exist for x86-64, Python 3.10 to 3.14.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

DISTRIBUTIONS = ("jazzy", "kilted")
PACKAGES = (
    *("rclpy", "rmw-fastrtps-cpp", "std-msgs", "sensor-msgs", "geometry-msgs"),
    *("diagnostic-msgs", "rosgraph-msgs"),
)


def folder(distribution: str) -> Path:
    """Where the environment of a distribution is, for this version of Python."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    return cache / "orthonav" / "ros2" / f"{distribution}-{version}"


def python(distribution: str) -> Path | None:
    """The interpreter of an environment; None where it was not made."""
    made = folder(distribution) / "bin" / "python"
    return made if (folder(distribution) / "complete").exists() else None


def make(distribution: str) -> None:
    """Make an environment. Raises `subprocess.CalledProcessError`."""
    path = folder(distribution)
    shutil.rmtree(path, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", path], check=True)
    wanted = [f"ros-{distribution}-{package}" for package in PACKAGES]
    own = path / "bin" / "python"
    subprocess.run([own, "-m", "pip", "install", "-q", *wanted], check=True)
    subprocess.run([own, "-c", "import rclpy; rclpy.init(); rclpy.shutdown()"], check=True)
    (path / "complete").touch()


def main() -> None:
    """Make what is missing."""
    for each in DISTRIBUTIONS:
        try:
            if python(each) is None:
                make(each)
            print(f"ROS 2 {each}: {folder(each)}")
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"ROS 2 {each} cannot be installed, its tests are skipped: {error}")


if __name__ == "__main__":
    main()
