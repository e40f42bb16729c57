"""Metadata of a photograph: EXIF (CIPA DC-008, Exif 2.32), XMP and maker notes."""

import math
import re
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.flight.telemetry_track import measured
from orthonav.core.guard import needed, reading
from orthonav.ground.recordings.focal import Optics
from orthonav.ground.recordings.makernotes import read_maker_notes
from orthonav.ground.recordings.xmp import Xmp

_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_XMP_TAG, _MAKE, _MODEL, _SOFTWARE = 700, 0x010F, 0x0110, 0x0131
_TIME, _TIME_ORIGINAL, _MAKER_NOTE = 0x0132, 0x9003, 0x927C
_OFFSET, _OFFSET_ORIGINAL = 0x9010, 0x9011
_SUBSEC, _SUBSEC_ORIGINAL = 0x9290, 0x9291
_FOCAL, _FOCAL_35, _PLANE_X, _PLANE_UNIT, _PIXELS_X = 0x920A, 0xA405, 0xA20E, 0xA210, 0xA002
_ZOOM = 0xA404
_QUARTER_HOUR = timedelta(minutes=15)


@dataclass(frozen=True, eq=False)
class Photo:
    """Metadata of one photograph; NaN and None where it has none."""

    width_px: int
    """Columns of the image."""
    height_px: int
    """Rows of the image."""
    time_ns: int | None
    """Time of exposure, UTC."""
    zone_known: bool
    """Whether the time zone was known; otherwise the camera's clock is assumed to be UTC."""
    latlon_deg: tuple[float, float] | None
    """Recorded position."""
    alt_m: float
    """Recorded altitude; its reference differs between makers."""
    gimbal_deg: tuple[float, float, float] | None
    """Yaw, pitch, roll of the gimbal as recorded, of a camera that looks ahead at 0, 0, 0."""
    rotation: NDArray[np.float64] | None
    """Attitude as `enu_from_camera` of a camera without a gimbal."""
    body_yaw_deg: float
    """Heading of the aircraft."""
    home_m: float
    """Height above take-off."""
    amsl_m: float
    """Height above mean sea level, where its reference is stated."""
    hae_m: float
    """Height above the ellipsoid, where its reference is stated."""
    vel_en_mps: tuple[float, float] | None
    """Velocity over ground, east and north."""
    optics: Optics
    """Camera and lens."""
    software: str
    """Programs that wrote the file; of a camera its firmware."""
    agl_m: float = math.nan
    """Height above ground, where a table states it."""
    doubts: tuple[str, ...] = ()
    """Values that are there and cannot be used: what is wrong with each."""


def read_photo(path: Path) -> Photo:
    """Metadata of the photograph at `path`; the image is not decoded.

    Raises `FlightError` where it is not an image.
    """
    pillow = needed("PIL.Image", "photographs")
    with reading("photograph", path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about large images and odd tags
        with pillow.open(path) as image:
            exif = image.getexif()
            tags = dict(exif)  # here, because tags are decoded on access
            more, gps = dict(exif.get_ifd(_EXIF_IFD)), dict(exif.get_ifd(_GPS_IFD))
            packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp")
            width, height = image.size
    # Some thermal cameras have XMP in the Exif directory.
    xmp = Xmp.of(packet or tags.get(_XMP_TAG) or more.get(_XMP_TAG) or b"")
    make = _word(tags.get(_MAKE))
    notes = read_maker_notes(_bytes(more.get(_MAKER_NOTE)), make)
    time_ns, zone_known = xmp.time_ns, True
    if time_ns is None:
        time_ns, zone_known = _time(tags, more, gps)
    latlon, alt = _place(gps)
    body_yaw = xmp.body_yaw_deg()
    if math.isnan(body_yaw) and not xmp.unread:
        body_yaw = notes.body_yaw_deg
    doubts = [f"unreadable value {value}" for value in sorted(xmp.unread)]
    if latlon is None and _lacks_references(gps):
        doubts.append("GPS position without N or S, or without E or W")
    return Photo(
        width_px=width,
        height_px=height,
        time_ns=time_ns,
        zone_known=zone_known,
        latlon_deg=xmp.latlon_deg() or latlon,
        alt_m=alt,
        gimbal_deg=xmp.gimbal_deg() or notes.gimbal_deg,
        rotation=xmp.rotation(make),
        body_yaw_deg=body_yaw,
        home_m=xmp.home_m(),
        amsl_m=xmp.first("sensefly:AltitudeAMSL"),
        hae_m=xmp.hae_m(),
        vel_en_mps=xmp.velocity_en_mps(),
        optics=_optics(tags, more),
        software=", ".join(filter(None, dict.fromkeys((_word(tags.get(_SOFTWARE)), xmp.writer)))),
        doubts=tuple(doubts),
    )


def _optics(tags: dict[int, Any], more: dict[int, Any]) -> Optics:
    unit = _number(more.get(_PLANE_UNIT) or 2)
    return Optics(
        make=_word(tags.get(_MAKE)),
        model=_word(tags.get(_MODEL)),
        focal_mm=_number(more.get(_FOCAL)),
        film_mm=_number(more.get(_FOCAL_35)),
        plane=_number(more.get(_PLANE_X)),
        plane_unit=int(unit) if math.isfinite(unit) else 0,
        taken_px=_number(more.get(_PIXELS_X)),
        zoom=_number(more.get(_ZOOM)),
    )


def _word(value: Any) -> str:
    return "" if value is None else str(value).strip("\0 ")


def _bytes(value: Any) -> bytes:
    return value if isinstance(value, bytes) else b""


def _time(
    tags: dict[int, Any], more: dict[int, Any], gps: dict[int, Any]
) -> tuple[int | None, bool]:
    """UTC in ns, and whether the time zone was known.

    The zone is that of `OffsetTimeOriginal`, else the difference between the camera's clock and
    the time of the GPS, rounded to quarters of an hour.
    """
    parts = (_TIME_ORIGINAL, _SUBSEC_ORIGINAL, _OFFSET_ORIGINAL)
    if not str(more.get(_TIME_ORIGINAL, "")).strip("\0 :"):
        more, parts = {**more, _TIME: tags.get(_TIME, "")}, (_TIME, _SUBSEC, _OFFSET)
    text, fraction, offset = (str(more.get(part, "")).strip("\0 ") for part in parts)
    try:
        local = datetime.strptime(text, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
        zone = _offset(offset)
        if zone is None and (utc := _gps_time(gps)) is not None:
            zone = round((local - utc) / _QUARTER_HOUR) * _QUARTER_HOUR
        whole = local - (zone or timedelta())
    except (ValueError, OverflowError):  # the latter for the years 1 and 9999
        return None, False
    nanoseconds = int(fraction[:9].ljust(9, "0")) if fraction.isdecimal() else 0
    return round(whole.timestamp()) * 10**9 + nanoseconds, zone is not None


def _offset(text: str) -> timedelta | None:
    found = re.fullmatch(r"([+-])(\d\d):(\d\d)", text)
    if found is None:
        return timedelta() if text == "Z" else None
    offset = timedelta(hours=int(found[2]), minutes=int(found[3]))
    return -offset if found[1] == "-" else offset


def _gps_time(gps: dict[int, Any]) -> datetime | None:
    """UTC of the GPS (tags 29 GPSDateStamp and 7 GPSTimeStamp)."""
    try:
        day = datetime.strptime(str(gps[29]).strip("\0 "), "%Y:%m:%d").replace(tzinfo=UTC)
        hours, minutes, seconds = (float(part) for part in gps[7])
        return day + timedelta(hours=hours, minutes=minutes, seconds=seconds)
    except (KeyError, ValueError, TypeError, ZeroDivisionError, OverflowError):
        return None


def _place(gps: dict[int, Any]) -> tuple[tuple[float, float] | None, float]:
    """Latitude and longitude in degrees, and altitude (tags 1 to 6)."""
    alt = measured(_number(gps.get(6)) * (-1 if gps.get(5) in (1, b"\x01") else 1))
    try:
        lat, lon = (sum(float(part) / 60**i for i, part in enumerate(gps[tag])) for tag in (2, 4))
    except (KeyError, ValueError, TypeError, ZeroDivisionError):
        return None, alt
    if _lacks_references(gps):
        return None, alt
    south, west = (_reference(gps, tag) in ("S", "W") for tag in (1, 3))
    lat, lon = -lat if south else lat, -lon if west else lon
    sound = abs(lat) <= 90 and abs(lon) <= 360 and (lat, lon) != (0.0, 0.0)
    return ((lat, lon) if sound else None), alt


def _reference(gps: dict[int, Any], tag: int) -> str:
    value = gps.get(tag, "")
    text = value.decode("latin-1") if isinstance(value, bytes) else str(value)
    return text.upper().strip("\0 ")[:1]


def _lacks_references(gps: dict[int, Any]) -> bool:
    """Whether latitude or longitude have no sign: no N, S, E or W."""
    placed = 2 in gps and 4 in gps
    return placed and not (_reference(gps, 1) in tuple("NS") and _reference(gps, 3) in tuple("EW"))


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
