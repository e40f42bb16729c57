"""Position fixes for aircraft without GNSS: a downward camera is compared with an orthophoto.

    import cv2, orthonav

    localizer = orthonav.Localizer(orthonav.open_map("area.onav"))
    camera = orthonav.Camera.from_fov(65, 1280, 960)
    fix = localizer.localize(cv2.imread("0100.jpg"), camera, agl_m=270, heading_deg=None)
    if isinstance(fix, orthonav.Fix) and fix.is_confident:
        print(fix.lat_deg, fix.lon_deg, fix.std_m, fix.heading_deg)

`build_map` makes a map from orthophotos, `Tracker` follows a flight, `evaluate` compares fixes with
ground truth. The names in `__all__` are stable from version 0.2 on; modules below are not.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

__all__ = [
    "CONFIDENT",
    "BuildRequest",
    "Camera",
    "Fix",
    "FlightFolder",
    "Localizer",
    "MapFile",
    "NoFix",
    "OrthonavError",
    "Prior",
    "SimulateRequest",
    "Telemetry",
    "Tracker",
    "View",
    "ViewResult",
    "build_map",
    "check",
    "evaluate",
    "open_flight",
    "open_map",
    "read_results",
    "read_truth",
    "simulate_flight",
    "to_dataframe",
    "to_geojson",
]
_HOMES = {
    **dict.fromkeys(("BuildRequest", "build_map"), "ground.build"),
    **dict.fromkeys(("CONFIDENT", "Fix", "NoFix", "Prior"), "core.records"),
    **dict.fromkeys(("Telemetry", "View", "ViewResult"), "core.records"),
    **dict.fromkeys(("FlightFolder", "open_flight", "read_truth"), "core.flight"),
    "Localizer": "core.localize",
    "Tracker": "core.track.tracker",
    **dict.fromkeys(("MapFile", "open_map"), "core.mapfile"),
    **dict.fromkeys(("SimulateRequest", "simulate_flight"), "ground.simulate.flight"),
    "Camera": "core.geo.camera",
    "check": "ground.check.run",
    "evaluate": "ground.evaluate.metrics",
    "OrthonavError": "core.errors",
    **dict.fromkeys(("read_results", "to_dataframe", "to_geojson"), "core.flight.fixes"),
}


def __getattr__(name: str) -> Any:
    """A public name, imported when it is used first."""
    if name not in _HOMES:
        raise AttributeError(f"module orthonav has no attribute {name}; see orthonav.__all__")
    globals()[name] = found = getattr(import_module(f"orthonav.{_HOMES[name]}"), name)
    return found


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
