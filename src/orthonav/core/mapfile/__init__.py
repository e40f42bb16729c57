"""The map file (`*.onav`): all data of a map in one file that is safe to open and to keep open."""

from orthonav.core.mapfile.layer import GreyLayer
from orthonav.core.mapfile.manifest import SCHEMA, GreyInfo, Manifest, SheetInfo
from orthonav.core.mapfile.reader import MapFile, open_map, write_map

__all__ = [
    "SCHEMA",
    "GreyInfo",
    "GreyLayer",
    "Manifest",
    "MapFile",
    "SheetInfo",
    "open_map",
    "write_map",
]
