"""Recordings of all kinds read as flights: photographs, videos, ROS recordings, autopilot logs."""

from orthonav.ground.recordings.flightlog import LoggedFlight
from orthonav.ground.recordings.opening import Imported, import_flight, open_source, source_kind
from orthonav.ground.recordings.recording import Recording, SourceOptions

__all__ = [
    "Imported",
    "LoggedFlight",
    "Recording",
    "SourceOptions",
    "import_flight",
    "open_source",
    "source_kind",
]
