"""Flight folders: views, telemetry, camera and, where known, truth. Format: design section 5."""

from orthonav.flight.folder import FlightFolder, FlightView, open_flight, read_image, read_truth
from orthonav.flight.writer import FlightWriter

__all__ = [
    "FlightFolder",
    "FlightView",
    "FlightWriter",
    "open_flight",
    "read_image",
    "read_truth",
]
