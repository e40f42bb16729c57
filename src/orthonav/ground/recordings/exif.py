"""Metadata of a photograph: EXIF (CIPA DC-008, Exif 2.32), XMP and maker notes.

Values of XMP are searched by the names of DJI, Autel, senseFly and Pix4D in the text of the packet:
some firmware writes undeclared prefixes, which no XML parser accepts. Conventions of angles:
`docs/flights.md`.
"""

import math
import re
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError
from orthonav.core.flight.telemetry_track import measured
from orthonav.core.geo.camera import enu_from_camera
from orthonav.core.guard import needed, reading
from orthonav.ground.recordings.image_table import ImageRow, ns_of

_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
MAX_FIELD_DEG = 110.0
"""Field of view along the longer side that is believed: wider lenses are fisheyes, whose pictures
need a calibration."""
_WIDE_ASPECT = 1.65  # pictures at least as wide are parts of a sensor of 4:3
_FOUR_THIRDS = 4 / 3
_GIVEN_STD, _PLANE_STD, _FILM_STD, _CROPPED_STD = 0.02, 0.03, 0.03, 0.06
"""Standard deviations by rule: focal lengths are rounded to 1 or 2 digits (2 to 3 %); whether a
wide picture is a part of its sensor makes 9 %."""


@dataclass(frozen=True)
class Sensor:
    """A known camera: its largest picture, and how its focal length is found.

    Smaller pictures keep the whole width or the whole height of the largest one.
    """

    width_px: int
    height_px: int
    width_mm: float | None
    """Width of the sensor, for `FocalLength`; None: the 35 mm equivalent is the better value."""
    std: float  # standard deviation of the focal length, as a fraction of it


_DJI_12MP = Sensor(4000, 3000, 6.2, 0.02)  # 1/2.3 inch, 1.55 um: the published fields of view
_DJI_1INCH = Sensor(5472, 3648, 13.2, 0.015)
_DJI_M43 = Sensor(5280, 3956, 17.3, 0.02)
_SENSORS: Mapping[tuple[str, str], Sensor] = {
    **{("DJI", name): _DJI_12MP for name in ("FC300C", "FC300S", "FC300X", "FC330", "FC350")},
    ("DJI", "FC220"): _DJI_12MP,
    **{("DJI", name): _DJI_1INCH for name in ("FC6310", "FC6310S", "FC6310R")},
    ("HASSELBLAD", "L1D-20C"): _DJI_1INCH,
    **{(make, "L2D-20C"): _DJI_M43 for make in ("DJI", "HASSELBLAD")},
    ("DJI", "M3E"): _DJI_M43,
    ("DJI", "FC6520"): _DJI_M43,
    ("DJI", "FC550"): Sensor(4608, 3456, 17.3, 0.02),
    ("DJI", "FC6540"): Sensor(6016, 4008, 23.5, 0.02),
    ("DJI", "ZENMUSEP1"): Sensor(8192, 5460, 35.9, 0.01),
    **{("DJI", name): Sensor(4000, 3000, None, 0.03) for name in ("FC2204", "FC7203", "FC7303")},
    ("DJI", "FC1102"): Sensor(3968, 2976, None, 0.03),
    ("DJI", "FC2103"): Sensor(4056, 3040, None, 0.03),
    ("DJI", "FC3170"): Sensor(8000, 6000, None, 0.03),
    ("DJI", "FC3411"): Sensor(5472, 3648, None, 0.03),
    **{("DJI", name): Sensor(8064, 6048, None, 0.03) for name in ("FC3582", "FC3682", "FC8482")},
    ("SENSEFLY", "SENSEFLY S.O.D.A."): Sensor(5472, 3648, 12.75, 0.02),
}
"""By maker and model as EXIF has them. Sizes by the makers' specifications; widths were compared
with their fields of view (docs/flights.md)."""


@dataclass(frozen=True)
class FocalLength:
    px: float  # in pixels, above 0
    std: float  # its standard deviation, as a fraction of it
    source: str  # where it comes from, for people

    def field_deg(self, longer_px: int) -> float:
        return math.degrees(2 * math.atan(longer_px / (2 * self.px)))


@dataclass(frozen=True)
class Optics:
    """What EXIF says about the optics; NaN for missing values."""

    make: str
    model: str
    focal_mm: float
    film_mm: float  # equivalent focal length on 35 mm film
    plane: float  # `FocalPlaneXResolution`
    plane_unit: int  # `FocalPlaneResolutionUnit`
    taken_px: float  # width of the picture as taken
    zoom: float  # `DigitalZoomRatio`


def focal_length(
    optics: Optics, width_px: int, height_px: int, sensor_width_mm: float | None = None
) -> FocalLength | None:
    """The focal length of a picture of this size, None where nothing is known of it.

    `sensor_width_mm`: longer side of the sensor, as the user knows it. Raises `CameraError` for a
    digital zoom, and where the picture would be wider than `MAX_FIELD_DEG`.
    """
    if optics.zoom > 1.0:
        raise CameraError(f"digital zoom of {optics.zoom:g}; give --camera FILE")
    longer_px = max(width_px, height_px)
    found = _found(optics, width_px, height_px, sensor_width_mm)
    if found is None or not math.isfinite(found.px):
        return None
    field_deg = found.field_deg(longer_px)
    if field_deg > MAX_FIELD_DEG:
        raise CameraError(
            f"focal length implies a field of view of {field_deg:.0f} deg; give --camera FILE"
        )
    return found


def _found(
    optics: Optics, width_px: int, height_px: int, sensor_width_mm: float | None
) -> FocalLength | None:
    if sensor_width_mm is not None and optics.focal_mm > 0:
        px = optics.focal_mm / sensor_width_mm * max(width_px, height_px)
        return FocalLength(px, _GIVEN_STD, "EXIF and the width of the sensor")
    sensor = _SENSORS.get((optics.make.upper(), optics.model.upper()))
    if sensor is not None and (known := _of_sensor(sensor, optics, width_px, height_px)):
        return known
    if optics.film_mm > 0:
        return _of_film(optics.film_mm, width_px, height_px)
    return _of_plane(optics, width_px, height_px)


def _of_sensor(sensor: Sensor, optics: Optics, width_px: int, height_px: int) -> FocalLength | None:
    """The focal length of a known camera; a picture keeps the sensor's width or its height."""
    if sensor.width_mm is not None:
        px = optics.focal_mm / sensor.width_mm * sensor.width_px
    else:
        diagonal_px = math.hypot(sensor.width_px, sensor.height_px)
        px = optics.film_mm / _FILM_DIAGONAL_MM * diagonal_px
    if not px > 0:
        return None
    longer_px, shorter_px = max(width_px, height_px), min(width_px, height_px)
    px *= max(longer_px / sensor.width_px, shorter_px / sensor.height_px)
    return FocalLength(px, sensor.std, f"EXIF, and the sensor of {optics.model}")


def _of_film(film_mm: float, width_px: int, height_px: int) -> FocalLength:
    longer_px, shorter_px = max(width_px, height_px), min(width_px, height_px)
    cropped = longer_px / shorter_px >= _WIDE_ASPECT
    whole_px = longer_px / _FOUR_THIRDS if cropped else shorter_px
    px = film_mm / _FILM_DIAGONAL_MM * math.hypot(longer_px, whole_px)
    if cropped:
        return FocalLength(px, _CROPPED_STD, "35 mm equivalent of EXIF, of an uncropped 4:3 sensor")
    return FocalLength(px, _FILM_STD, "35 mm equivalent of EXIF")


def _of_plane(optics: Optics, width_px: int, height_px: int) -> FocalLength | None:
    """Of the resolution of the sensor. Some cameras write its width there instead."""
    unit_mm = _MM_PER_UNIT.get(optics.plane_unit, math.nan)
    taken_px = optics.taken_px if optics.taken_px > 0 else float(width_px)
    thinned = width_px / taken_px
    px, longer_px = optics.focal_mm * optics.plane / unit_mm * thinned, max(width_px, height_px)
    if not px > 0:
        return None
    found = FocalLength(px, _PLANE_STD, "focal length and sensor resolution of EXIF")
    px = optics.focal_mm / (optics.plane * unit_mm) * width_px
    as_width = replace(
        found, px=px, source="EXIF, with the sensor's width instead of its resolution"
    )
    wide = found.field_deg(longer_px) > MAX_FIELD_DEG
    return as_width if wide and as_width.field_deg(longer_px) <= MAX_FIELD_DEG else found


_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_XMP_TAG, _MAKE, _MODEL, _SOFTWARE, _ORIENTATION = 700, 0x010F, 0x0110, 0x0131, 0x0112
MAX_POSITION_ERROR_M, MAX_DOP = 100.0, 20.0  # of positions that are no truth if they have more
_TIME, _TIME_ORIGINAL, _MAKER_NOTE = 0x0132, 0x9003, 0x927C
_OFFSET, _OFFSET_ORIGINAL = 0x9010, 0x9011
_SUBSEC, _SUBSEC_ORIGINAL = 0x9290, 0x9291
_FOCAL, _FOCAL_35, _PLANE_X, _PLANE_UNIT, _PIXELS_X = 0x920A, 0xA405, 0xA20E, 0xA210, 0xA002
_ZOOM = 0xA404
_ZONE = re.compile(r"Z|[+-][01]\d:?[0-5]\d")
_FLOAT, _ENTRY_BYTES, _MAX_ENTRIES = 11, 12, 100
_BODY_YAW, _CAMERA_ANGLES = 7, (10, 9, 11)  # yaw, pitch, roll
_VALUE = re.compile(
    r"(?<![/\w-])([A-Za-z][\w-]{0,20}:[A-Za-z0-9]+)\s*(?:=\s*[\"']|>)\s*"
    r"([^\"'<\s][^\"'<]{0,60}?)\s*[\"'<]"
)
_NUMBER = re.compile(r"([-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d{1,2})?)(?:\s*/\s*(\d+(?:[.,]\d+)?))?")
"""A number with a decimal point or comma, or a fraction."""
_ANGLE_OR_PLACE = re.compile(
    r"(?:drone(?:-dji)?|Camera|sensefly|skydio|drone-parrot):(?:Gimbal|Flight(?:Yaw|Pitch|Roll)|"
    r"(?:Camera)?(?:Yaw|Pitch|Roll)|Heading|Altitude|Height|Lat|Lon)"
)
"""Values that a view is worse off without."""
_SKYDIO = re.compile(r"(?s)(drone-skydio:CameraOrientationNED\b)(?:[^<>]{0,600}/>|.{0,600}?</\1)")
_EXPOSED = re.compile(
    r"\b(?:drone-dji:UTCAtExposure|sensefly:UTCTime)\s*(?:=\s*[\"']|>)\s*"
    r"(\d{4})[-:](\d\d)[-:](\d\d)[T ](\d\d:\d\d:\d\d(?:\.\d{1,9})?)"
)
_DEWARP = re.compile(
    r"\bdrone-dji:DewarpData\s*(?:=\s*[\"']|>)\s*[\d-]{8,10};([-+\d.eE]{1,30}(?:,[-+\d.eE]{1,30}){8})"
)
"""Date; then fx, fy, cx, cy from the middle of the picture in px, k1, k2, p1, p2, k3."""
_WRITER = re.compile(r"\bxmp:CreatorTool\s*(?:=\s*[\"']|>)\s*([^\"'<]{1,200})")


@dataclass(frozen=True, eq=False)
class Photo:
    """Metadata of one photograph; NaN and None where it has none."""

    path: Path
    width_px: int  # columns of the image
    height_px: int  # rows of the image
    time_ns: int | None  # time of exposure, UTC
    zone_known: bool
    """Whether the time zone was known; otherwise the camera's clock is assumed to be UTC."""
    gps_ns: int | None  # time of the GPS, which may be some seconds old
    latlon_deg: tuple[float, float] | None  # recorded position
    alt_m: float  # recorded altitude; its reference differs between makers
    gimbal_deg: tuple[float, float, float] | None
    """Yaw, pitch, roll of the gimbal as recorded, of a camera that looks ahead at 0, 0, 0."""
    rotation: NDArray[np.float64] | None
    """Attitude as `enu_from_camera` of a camera without a gimbal."""
    body_yaw_deg: float  # heading of the aircraft
    home_m: float  # height above take-off
    amsl_m: float  # height above mean sea level, where its reference is stated
    hae_m: float  # height above the ellipsoid, where its reference is stated
    vel_en_mps: tuple[float, float] | None  # velocity over ground, east and north
    optics: Optics  # camera and lens
    lens: tuple[float, ...] | None
    """DJI's calibration of a picture that is as the lens made it: fx, fy, and the principal point
    from the middle, px; k1, k2, p1, p2, k3."""
    software: str  # programs that wrote the file; of a camera its firmware
    turned: bool  # whether other programs show it turned, by the orientation of EXIF
    agl_m: float = math.nan  # height above ground, where a table states it
    doubts: tuple[str, ...] = ()
    """Values that are there and cannot be used: what is wrong with each."""
    row: ImageRow | None = None  # what a table says of it
    pose: Mapping[str, Any] = field(default_factory=dict)
    """Its attitude as fields of `Telemetry`, once all photographs of the flight are known."""


def read_photo(path: Path) -> Photo:
    """Metadata of the photograph at `path`; the image is not decoded."""
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
    notes = more.get(_MAKER_NOTE)
    gimbal, heading = read_maker_notes(notes if isinstance(notes, bytes) else b"", make)
    time_ns, zone_known = (xmp.time_ns, True) if xmp.time_ns else _time(tags, more)
    gps_ns = None if xmp.time_ns else _gps_time_ns(gps)  # that of XMP is of the exposure
    if void := _void(gps):
        gps = {}
    latlon, alt, doubt = _place(gps)
    rtk = xmp.first("drone-dji:RtkFlag") > 0
    north, east = (
        xmp.first(f"drone-dji:Flight{axis}Speed", f"drone:Flight{axis}Speed") for axis in "XY"
    )
    body_yaw = xmp.body_yaw_deg()
    if math.isnan(body_yaw) and not xmp.unread:
        body_yaw = heading
    gimbal, rotation = xmp.gimbal_deg() or gimbal, xmp.rotation(make)
    doubts = [f"unreadable value {value}" for value in sorted(xmp.unread)]
    if gimbal is None and rotation is None and math.isnan(body_yaw):
        others = [name for name in xmp.values if "Yaw" in name or "Heading" in name]
        others += ["GPSImgDirection"] if 17 in gps else []
        doubts += [f"angles of {other}, which are not read" for other in others[:1]]
    return Photo(
        path=path,
        width_px=width,
        height_px=height,
        time_ns=time_ns,
        zone_known=zone_known,
        gps_ns=None if void else gps_ns,
        latlon_deg=None if void else xmp.latlon_deg() or latlon,
        alt_m=alt,
        gimbal_deg=gimbal,
        rotation=rotation,
        body_yaw_deg=body_yaw,
        home_m=measured(
            xmp.first(
                *("drone-dji:RelativeAltitude", "drone:RelativeAltitude", "sensefly:Height"),
                *("drone-skydio:RelativeAltitude", "drone-parrot:RelativeAltitude"),
            )
        ),
        amsl_m=xmp.first("sensefly:AltitudeAMSL"),
        hae_m=xmp.first("drone-dji:AbsoluteAltitude" if rtk else "sensefly:AltitudeWGS84"),
        vel_en_mps=(east, north) if math.isfinite(east + north) else None,
        optics=_optics(tags, more),
        lens=xmp.lens if xmp.first("drone-dji:DewarpFlag") == 0 else None,
        software=", ".join(filter(None, dict.fromkeys((_word(tags.get(_SOFTWARE)), xmp.writer)))),
        turned=tags.get(_ORIENTATION, 1) not in (0, 1),
        doubts=tuple(filter(None, (*doubts, void, doubt))),
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
    text = value.decode("latin-1") if isinstance(value, bytes) else value
    return "" if value is None else str(text).strip("\0 ")


def _time(tags: dict[int, Any], more: dict[int, Any]) -> tuple[int | None, bool]:
    """Time in ns by the camera's clock, and whether it is UTC, by `OffsetTimeOriginal`."""
    parts = (_TIME_ORIGINAL, _SUBSEC_ORIGINAL, _OFFSET_ORIGINAL)
    if not str(more.get(_TIME_ORIGINAL, "")).strip("\0 :"):
        more, parts = {**more, _TIME: tags.get(_TIME, "")}, (_TIME, _SUBSEC, _OFFSET)
    text, fraction, zone = (str(more.get(part, "")).strip("\0 ") for part in parts)
    zone = zone if _ZONE.fullmatch(zone) else ""
    nanoseconds = int(fraction[:9].ljust(9, "0")) if fraction.isdecimal() else 0
    try:
        moment = datetime.strptime(text + zone, "%Y:%m:%d %H:%M:%S" + "%z" * bool(zone))
        return ns_of(moment) + nanoseconds, bool(zone)
    except ValueError:
        return None, False


def _gps_time_ns(gps: dict[int, Any]) -> int | None:
    try:
        day = datetime.strptime(str(gps[29]).strip("\0 "), "%Y:%m:%d").replace(tzinfo=UTC)
        hours, minutes, seconds = (float(part) for part in gps[7])
        return round((day.timestamp() + hours * 3600 + minutes * 60 + seconds) * 1e9)
    except (KeyError, ValueError, TypeError, ZeroDivisionError, OverflowError):
        return None


def _place(gps: dict[int, Any]) -> tuple[tuple[float, float] | None, float, str]:
    """Latitude and longitude in degrees, altitude, and why there is none (tags 1 to 6)."""
    alt = measured(_number(gps.get(6)) * (-1 if gps.get(5) in (1, 3, b"\x01", b"\x03") else 1))
    try:
        lat, lon = (sum(float(part) / 60**i for i, part in enumerate(gps[tag])) for tag in (2, 4))
    except (KeyError, ValueError, TypeError, ZeroDivisionError):
        return None, alt, ""
    north, east = (_word(gps.get(tag)).upper()[:1] for tag in (1, 3))
    if north not in tuple("NS") or east not in tuple("EW"):
        return None, alt, "GPS position without N or S, or without E or W"
    lat, lon = -lat if north == "S" else lat, -lon if east == "W" else lon
    sound = abs(lat) <= 90 and abs(lon) <= 360 and (lat, lon) != (0.0, 0.0)
    return ((lat, lon) if sound else None), alt, ""


def _void(gps: dict[int, Any]) -> str:
    """Why the receiver's values are not used, empty where they are."""
    if _word(gps.get(9)).upper() == "V" or _word(gps.get(10)) == "0":
        return "GPS position without a fix (GPSStatus, GPSMeasureMode)"
    if _number(gps.get(31)) > MAX_POSITION_ERROR_M or _number(gps.get(11)) > MAX_DOP:
        return "GPS position with a large error (GPSHPositioningError, GPSDOP)"
    return ""


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan


def read_maker_notes(data: bytes, make: str) -> tuple[tuple[float, float, float] | None, float]:
    """Yaw, pitch and roll of the gimbal, as in DJI's XMP, and heading of the aircraft.

    They are in the maker notes of DJI's older models; other makers' are not read. An IFD of TIFF
    without a header: the number of entries, then 12 bytes each. Tags as ExifTool lists them
    (`Image::ExifTool::DJI`): 6 to 8 pitch, yaw and roll of the aircraft, 9 to 11 of the camera.
    """
    if make.upper() != "DJI":
        return None, math.nan
    values: dict[int, float] = {}
    # Programs that rewrite EXIF may change its byte order, not that of the notes.
    for order in "<>":
        count = struct.unpack_from(f"{order}H", data.ljust(2, b"\0"))[0]
        if values or not 1 <= count <= _MAX_ENTRIES or len(data) < 2 + count * _ENTRY_BYTES:
            continue
        for number in range(count):
            entry = struct.unpack_from(f"{order}HHIf", data, 2 + number * _ENTRY_BYTES)
            if entry[1:3] == (_FLOAT, 1) and abs(entry[3]) <= 360:
                values[entry[0]] = entry[3]
    yaw, pitch, roll = (values.get(tag, math.nan) for tag in _CAMERA_ANGLES)
    known = math.isfinite(yaw + pitch + roll)
    return (yaw, pitch, roll) if known else None, values.get(_BODY_YAW, math.nan)


@dataclass(frozen=True)
class Xmp:
    """The values of a packet by prefix and name, and what they mean; NaN and None for missing."""

    values: Mapping[str, float]
    time_ns: int | None  # UTC at exposure
    writer: str  # program that wrote the packet, empty where it is not named
    lens: tuple[float, ...] | None = None  # `DewarpData`, see `Photo`
    unread: tuple[str, ...] = ()
    """Angles, heights and positions that are not numbers, as name and value."""

    @classmethod
    def of(cls, packet: str | bytes) -> "Xmp":
        text = packet.decode("utf-8", errors="replace") if isinstance(packet, bytes) else packet
        camera = _SKYDIO.search(text)  # its names are those of the aircraft's angles too
        skydio = camera[0].replace("drone-skydio:", "skydio:") if camera else ""
        texts = dict(_VALUE.findall(skydio + text))
        found = {name: _stated(value) for name, value in texts.items()}
        values = {name: value for name, value in found.items() if math.isfinite(value)}
        unread = tuple(
            f"{name}={texts[name]!r:.40}"
            for name in found.keys() - values.keys()
            if _ANGLE_OR_PLACE.match(name)
        )
        writer = _WRITER.search(text)
        name = writer[1].strip() if writer else ""
        return cls(values, _exposed_ns(text), name, _lens(text), unread)

    def first(self, *names: str) -> float:
        return next((self.values[name] for name in names if name in self.values), math.nan)

    def latlon_deg(self) -> tuple[float, float] | None:
        """The position, which may be of RTK; `GpsLongtitude` is a common misspelling."""
        for names in (
            ("drone-dji:GpsLatitude", "drone-dji:GpsLongitude", "drone-dji:GpsLongtitude"),
            ("drone:GpsLatitude", "drone:GpsLongitude", "drone:GpsLongtitude"),
            ("sensefly:Latitude", "sensefly:Longitude"),
        ):
            lat, lon = self.first(names[0]), self.first(*names[1:])
            if abs(lat) <= 90 and abs(lon) <= 360 and (lat, lon) != (0.0, 0.0):
                return lat, lon
        return None

    def gimbal_deg(self) -> tuple[float, float, float] | None:
        """Yaw, pitch and roll of the gimbal, of a camera that looks ahead at 0, 0, 0."""
        forms = "drone-dji:Gimbal{}Degree", "drone:Gimbal{}Degree", "drone-parrot:Camera{}Degree"
        return next(filter(None, map(self._angles, (*forms, "skydio:{}"))), None)

    def body_yaw_deg(self) -> float:
        """Heading of the aircraft; NaN where a gimbal has another one that cannot be read."""
        if any("Gimbal" in value for value in self.unread):
            return math.nan
        return self.first("drone-dji:FlightYawDegree", "drone:FlightYawDegree")

    def rotation(self, make: str) -> NDArray[np.float64] | None:
        """`enu_from_camera` of a camera without a gimbal, whose maker is `make`."""
        heading, pitch, roll = (
            self.first(f"sensefly:{name}") for name in ("Heading", "PitchAngle", "RollAngle")
        )
        if math.isfinite(heading + pitch + roll):  # of the body; the camera looks straight down
            return enu_from_camera(heading, pitch, roll)
        angles = self._angles("Camera:{}")
        if angles is None or not any(angles):  # 0, 0, 0 was not recorded
            return None
        # senseFly uses the names of Pix4D with the opposite sign of roll.
        yaw, pitch, roll = angles
        return enu_from_camera(yaw, pitch, -roll if "sensefly" in make.lower() else roll)

    def _angles(self, pattern: str) -> tuple[float, float, float] | None:
        yaw, pitch, roll = (self.first(pattern.format(name)) for name in ("Yaw", "Pitch", "Roll"))
        return (yaw, pitch, roll) if math.isfinite(yaw + pitch + roll) else None


def _lens(text: str) -> tuple[float, ...] | None:
    found = _DEWARP.search(text)
    try:
        return tuple(map(float, found[1].split(","))) if found else None
    except ValueError:
        return None


def _stated(text: str) -> float:
    found = _NUMBER.fullmatch(text)
    if found is None:
        return math.nan
    over, under = (float((part or "1").replace(",", ".")) for part in found.groups())
    return over / under if under else math.nan


def _exposed_ns(text: str) -> int | None:
    if (found := _EXPOSED.search(text)) is None:
        return None
    try:
        return ns_of(datetime.fromisoformat("{}-{}-{}T{}".format(*found.groups())))
    except ValueError:
        return None
