"""Which extras each command needs: asked before it runs, and shown by `orthonav --version -v`."""

from collections.abc import Mapping

from orthonav.core.extras import require

NEEDS: Mapping[str, tuple[str, ...]] = {
    "demo": ("geo", "report", "web"),
    "simulate": ("geo",),
    "fetch --source": ("fetch",),
    "build": ("geo",),
    "check": ("geo", "report", "web"),
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
    "localize --atlas": ("atlas",),
    "localize, fly --require-signed": ("signing",),
    "localize, import, calibrate: photographs, ROS, logs": ("flights",),
    "fly --autopilot, --log": ("autopilot",),
    "fly --ros2": ("ros2",),
    "evaluate --report": ("report",),
}
"""Extras by command, or by command with an option or an input."""


def require_extras(command: str) -> None:
    """Raise `MissingExtraError`, one line with all that is missing, unless a command can run."""
    require(f"orthonav {command}", *NEEDS.get(command, ()))
