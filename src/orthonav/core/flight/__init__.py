"""Flight folders: views, telemetry, camera and, where known, truth (docs/reference/formats.md)."""

from orthonav.core.flight.folder import (
    FlightFolder,
    FlightWriter,
    decode_image,
    open_flight,
    read_camera,
    read_image,
    read_truth,
)
from orthonav.core.flight.recording import Flight, RecordedView

__all__ = [
    "Flight",
    "FlightFolder",
    "FlightWriter",
    "RecordedView",
    "decode_image",
    "open_flight",
    "read_camera",
    "read_image",
    "read_truth",
]
