"""`orthonav --version`, and which extras each command needs."""

import json
import platform
from collections.abc import Mapping, Sequence
from typing import Any

from orthonav import __version__
from orthonav.core.cores import usable_cores
from orthonav.core.extras import missing, packages, pip_line, require

NEEDS: Mapping[str, tuple[str, ...]] = {
    "demo": ("geo", "report", "web"),
    "run": ("geo", "report"),
    "simulate": ("geo",),
    "fetch --source": ("fetch",),
    "build": ("geo",),
    "check": ("geo", "report", "web"),
    "evaluate": ("geo",),
    "atlas": ("geo",),
    "sign": ("signing",),
    "verify": ("signing",),
    "view": ("web",),
    # Only with these options or inputs; the part that needs it says so.
    "plan, localize, calibrate --dem": ("geo",),
    "build --edges segments": ("segments",),
    "build --method autoencoder, caevl, triplet or bovw": ("train",),
    "atlas build, atlas index": ("atlas",),
    "atlas build --cluster": ("cluster",),
    "build --edges onnx": ("neural",),
    "localize, fly: a map with a neural encoder or with onnx edges": ("neural",),
    "localize ATLAS": ("atlas",),
    "localize, fly --require-signed": ("signing",),
    "localize, import, calibrate: photographs, ROS, logs": ("flights",),
    "fly --autopilot, --log": ("autopilot",),
    "fly --ros2": ("ros2",),
    "evaluate --report": ("geo", "report"),
    "run, as all others: words completed by the shell": ("completion",),
}
"""Extras by command, or by command with an option or an input."""


def require_extras(command: str) -> None:
    """Raise `MissingExtraError`, one line with all that is missing, unless a command can run."""
    require(f"orthonav {command}", *NEEDS.get(command, ()))


def show_version(arguments: Sequence[str]) -> int:
    """Print what `--version`, with `--verbose` or `--json` beside it, asks for."""
    whole = not {"-v", "--verbose", "--json"}.isdisjoint(arguments)
    print(json.dumps(about(), indent=1) if whole else f"orthonav {__version__}")
    return 0


def about() -> dict[str, Any]:
    """Plain values: versions, extras with what they lack, commands that lack one, the machine."""
    names = sorted({extra for needed in NEEDS.values() for extra in needed})
    return {
        "orthonav": __version__,
        "python": f"{platform.python_version()} ({platform.python_implementation()})",
        "platform": platform.platform(),
        "processor": {
            "machine": platform.machine(),
            "cores": usable_cores(),
            "features": _features(),
            "kernel": _has_kernel(),
        },
        "core": {each.name: each.version or None for each in packages()},
        "extras": {
            name: {each.name: each.version or None for each in packages(name)} for name in names
        },
        "unavailable": _unavailable(names),
        "missing": {
            command: _answer(lacking)
            for command, needed in NEEDS.items()
            if (lacking := [name for name in needed if missing(name)])
        },
    }


def _unavailable(extras: Sequence[str]) -> list[str]:
    """Packages of extras that are not installed and not made for this machine and Python."""
    of_all = (package for name in extras for package in packages(name))
    return sorted({each.name for each in of_all if not (each.available or each.version)})


def _answer(extras: Sequence[str]) -> str:
    """What to type for these extras, or which of their packages this machine cannot install."""
    if never := _unavailable(extras):
        return (
            f"{', '.join(never)}: no wheel for this machine and Python; source ROS 2 (docs/ros2.md)"
        )
    return pip_line(*extras)


def _has_kernel() -> bool:
    """Whether registration uses its compiled kernel; false without NumPy or OpenCV."""
    try:
        from orthonav.core.register.kernel import KERNEL
    except ImportError:
        return False
    return KERNEL is not None


def _features() -> list[str] | None:
    """Instruction sets that OpenCV was built for and the processor has; None without OpenCV."""
    try:
        import cv2
    except ImportError:
        return None
    line = cv2.getCPUFeaturesLine().split()
    # OpenCV marks with * what is chosen at run time, with ? what this processor lacks.
    return [name.lstrip("*") for name in line if not name.endswith("?")]
