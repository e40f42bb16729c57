"""Recordings of all kinds read as flights: photographs, videos, ROS recordings, autopilot logs."""

from orthonav.core.flight.source_options import KINDS, ROLES, SourceOptions
from orthonav.ground.recordings.flightlog import LoggedFlight
from orthonav.ground.recordings.importing import Imported, import_flight
from orthonav.ground.recordings.opening import open_source, source_kind
from orthonav.ground.recordings.over_terrain import OverTerrain
from orthonav.ground.recordings.recording import Recording, SourceView

__all__ = [
    "KINDS",
    "ROLES",
    "Imported",
    "LoggedFlight",
    "OverTerrain",
    "Recording",
    "SourceOptions",
    "SourceView",
    "import_flight",
    "open_source",
    "source_kind",
]
