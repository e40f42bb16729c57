"""Recordings of all kinds read as flights: photographs, videos, ROS recordings, autopilot logs."""

from orthonav.sources.flightlog import LoggedFlight
from orthonav.sources.importing import Imported, import_flight
from orthonav.sources.opening import open_source, source_kind
from orthonav.sources.options import KINDS, ROLES, SourceOptions
from orthonav.sources.over_terrain import OverTerrain
from orthonav.sources.recording import Recording, SourceView

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
