"""Angles in the maker notes of DJI's older models.

An IFD of TIFF without a header: the number of entries, then 12 bytes each. Tags as ExifTool lists
them (`Image::ExifTool::DJI`): 6 to 8 pitch, yaw and roll of the aircraft, 9 to 11 of the camera.
"""

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

_FLOAT, _ENTRY_BYTES, _MAX_ENTRIES = 11, 12, 100
_BODY_YAW, _CAMERA_PITCH, _CAMERA_YAW, _CAMERA_ROLL = 7, 9, 10, 11


@dataclass(frozen=True)
class MakerNotes:
    """Angles of maker notes, degrees."""

    gimbal_deg: tuple[float, float, float] | None = None
    """Yaw, pitch, roll of the gimbal, as in DJI's XMP."""
    body_yaw_deg: float = math.nan
    """Heading of the aircraft."""


def read_maker_notes(data: bytes, make: str) -> MakerNotes:
    """The angles in the maker notes of a camera of this make; other makers' are not read."""
    if make.strip("\0 ").upper() != "DJI":
        return MakerNotes()
    # Programs that rewrite EXIF may change its byte order but not that of the notes.
    values = next(filter(None, (_floats(data, order) for order in "<>")), {})
    yaw, pitch, roll = (
        values.get(tag, math.nan) for tag in (_CAMERA_YAW, _CAMERA_PITCH, _CAMERA_ROLL)
    )
    known = math.isfinite(yaw + pitch + roll)
    return MakerNotes((yaw, pitch, roll) if known else None, values.get(_BODY_YAW, math.nan))


def _floats(data: bytes, order: str) -> Mapping[int, float]:
    """Single floats by tag; empty where this is no IFD of that byte order."""
    if len(data) < 2:
        return {}
    (count,) = struct.unpack_from(f"{order}H", data)
    if not 1 <= count <= _MAX_ENTRIES or len(data) < 2 + count * _ENTRY_BYTES:
        return {}
    found = {}
    for number in range(count):
        entry = struct.unpack_from(f"{order}HHIf", data, 2 + number * _ENTRY_BYTES)
        tag, kind, values, value = entry
        if kind == _FLOAT and values == 1 and abs(value) <= 360:
            found[tag] = value
    return found
