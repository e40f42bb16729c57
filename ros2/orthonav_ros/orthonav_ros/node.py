"""`ros2 run orthonav_ros orthonav_node MAP.onav [OPTIONS] [--ros-args ...]`.

The options are those of `orthonav fly`.
"""

import sys

from orthonav.cli import main as orthonav


def main() -> int:
    """Fly until SIGINT or SIGTERM; the exit code."""
    words = sys.argv[1:]
    end = words.index("--ros-args") if "--ros-args" in words else len(words)
    return orthonav(["fly", *words[:end], "--ros2", *words[end:]])


if __name__ == "__main__":
    sys.exit(main())
