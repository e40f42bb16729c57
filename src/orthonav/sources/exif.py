"""Metadata of a photograph: EXIF, and XMP of DJI, Autel, senseFly and Pix4D.

EXIF: CIPA DC-008 (Exif 2.32). XMP: values by the manufacturers' names, searched in the text of the
packet: some firmware writes undeclared prefixes, which no XML parser accepts.
"""

import math
import re
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.geo.camera import enu_from_camera
from orthonav.sources.attitude import enu_from_gimbal_camera
from orthonav.sources.guard import needed, reading

_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_XMP_TAG, _MAKE, _TIME, _TIME_ORIGINAL = 700, 0x010F, 0x0132, 0x9003
_OFFSET, _OFFSET_ORIGINAL = 0x9010, 0x9011
_SUBSEC, _SUBSEC_ORIGINAL = 0x9290, 0x9291
_FOCAL, _FOCAL_35, _PLANE_X, _PLANE_UNIT, _PIXELS_X = 0x920A, 0xA405, 0xA20E, 0xA210, 0xA002
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_QUARTER_HOUR = timedelta(minutes=15)
_XMP = re.compile(
    r"\b(drone-dji|drone|Camera):([A-Za-z]+)\s*(?:=\s*[\"']|>)\s*([-+]?\d+(?:\.\d+)?)"
)
_EXPOSED = re.compile(
    r"\bdrone-dji:UTCAtExposure\s*(?:=\s*[\"']|>)\s*"
    r"(\d{4})[-:](\d\d)[-:](\d\d)[T ](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?"
)


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
    """Recorded altitude."""
    rotation: NDArray[np.float64] | None
    """Attitude as `enu_from_camera`."""
    height_m: float
    """Height above take-off."""
    vel_en_mps: tuple[float, float] | None
    """Velocity over ground, east and north."""
    focal_px: float | None
    """Focal length for an image of `width_px`."""


def read_photo(path: Path, sensor_width_mm: float | None = None) -> Photo:
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
    text = _text(packet or tags.get(_XMP_TAG) or b"")
    xmp = {f"{maker}:{name}": float(value) for maker, name, value in _XMP.findall(text)}
    time_ns, zone_known = _exposed_ns(text), True
    if time_ns is None:
        time_ns, zone_known = _time(tags, more, gps)
    latlon, alt = _place(gps)
    return Photo(
        width_px=width,
        height_px=height,
        time_ns=time_ns,
        zone_known=zone_known,
        latlon_deg=_exact_place(xmp) or latlon,
        alt_m=alt,
        rotation=_rotation(xmp, str(tags.get(_MAKE, ""))),
        height_m=_first(xmp, "drone-dji:RelativeAltitude", "drone:RelativeAltitude"),
        vel_en_mps=_velocity(xmp),
        focal_px=_focal_px(more, width, height, sensor_width_mm),
    )


def _text(packet: str | bytes) -> str:
    return packet.decode("utf-8", errors="replace") if isinstance(packet, bytes) else packet


def _exposed_ns(text: str) -> int | None:
    """UTC in ns at exposure, as DJI's survey cameras write it."""
    found = _EXPOSED.search(text)
    if found is None:
        return None
    try:
        whole = datetime(*map(int, found.groups()[:6]), tzinfo=UTC)  # type: ignore[misc,arg-type]
    except ValueError:
        return None
    return round(whole.timestamp()) * 10**9 + int((found[7] or "0").ljust(9, "0"))


def _exact_place(xmp: dict[str, float]) -> tuple[float, float] | None:
    """The position of XMP, which may be of RTK; `GpsLongtitude` is a common misspelling."""
    for maker in ("drone-dji", "drone"):
        lat = _first(xmp, f"{maker}:GpsLatitude")
        lon = _first(xmp, f"{maker}:GpsLongitude", f"{maker}:GpsLongtitude")
        if abs(lat) <= 90 and abs(lon) <= 360 and (lat, lon) != (0.0, 0.0):
            return lat, lon
    return None


def _first(xmp: dict[str, float], *names: str) -> float:
    return next((xmp[name] for name in names if name in xmp), math.nan)


def _rotation(xmp: dict[str, float], make: str) -> NDArray[np.float64] | None:
    for maker in ("drone-dji", "drone"):
        angles = [_first(xmp, f"{maker}:Gimbal{name}Degree") for name in ("Yaw", "Pitch", "Roll")]
        if np.isfinite(angles).all():
            return enu_from_gimbal_camera(angles)
    yaw, pitch, roll = (_first(xmp, f"Camera:{name}") for name in ("Yaw", "Pitch", "Roll"))
    if not math.isfinite(yaw + pitch + roll):
        return None
    # senseFly uses the names of Pix4D with the opposite sign of roll.
    return enu_from_camera(yaw, pitch, -roll if "sensefly" in make.lower() else roll)


def _velocity(xmp: dict[str, float]) -> tuple[float, float] | None:
    north, east = (
        _first(xmp, f"drone-dji:Flight{axis}Speed", f"drone:Flight{axis}Speed") for axis in "XY"
    )
    return (east, north) if math.isfinite(east + north) else None


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
    except ValueError:
        return None, False
    zone = _offset(offset)
    if zone is None and (utc := _gps_time(gps)) is not None:
        zone = round((local - utc) / _QUARTER_HOUR) * _QUARTER_HOUR
    whole = local - (zone or timedelta())
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
    alt = _number(gps.get(6)) * (-1 if gps.get(5) in (1, b"\x01") else 1)
    try:
        lat, lon = (sum(float(part) / 60**i for i, part in enumerate(gps[tag])) for tag in (2, 4))
        south, west = (str(gps[tag]).upper().strip("\0 ") in ("S", "W") for tag in (1, 3))
    except (KeyError, ValueError, TypeError, ZeroDivisionError):
        return None, alt
    lat, lon = -lat if south else lat, -lon if west else lon
    sound = abs(lat) <= 90 and abs(lon) <= 360 and (lat, lon) != (0.0, 0.0)
    return ((lat, lon) if sound else None), alt


def _focal_px(
    more: dict[int, Any], width_px: int, height_px: int, sensor_width_mm: float | None
) -> float | None:
    """Focal length in pixels, good to some per cent, or None."""
    focal_mm, film_mm = _number(more.get(_FOCAL)), _number(more.get(_FOCAL_35))
    if sensor_width_mm is not None and focal_mm > 0:
        return focal_mm / sensor_width_mm * width_px
    if film_mm > 0:  # equivalent of the diagonal: CIPA DCG-001
        return film_mm / _FILM_DIAGONAL_MM * math.hypot(width_px, height_px)
    unit_mm = _MM_PER_UNIT.get(int(more.get(_PLANE_UNIT) or 2), math.nan)
    px_per_mm = _number(more.get(_PLANE_X)) / unit_mm
    taken_px = _number(more.get(_PIXELS_X))
    if not (focal_mm > 0 and px_per_mm > 0):
        return None
    return focal_mm * px_per_mm * (width_px / taken_px if taken_px > 0 else 1.0)


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
