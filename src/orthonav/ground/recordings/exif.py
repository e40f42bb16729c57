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
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError
from orthonav.core.geo.camera import enu_from_camera
from orthonav.core.guard import needed, reading
from orthonav.ground.recordings.image_table import moment_of, ns_of
from orthonav.ground.recordings.telemetry_track import measured

MAX_FIELD_DEG = 110.0
"""Field of view along the longer side that is believed: wider lenses are fisheyes, whose pictures
need a calibration."""


class Sensor(NamedTuple):
    """A known camera: its largest picture, of which others keep the whole width or height."""

    width_px: int
    height_px: int
    width_mm: float | None  # for `FocalLength`; None: the 35 mm equivalent is the better value
    std: float  # standard deviation of the focal length, as a fraction of it


_SENSORS: Mapping[tuple[str, str], Sensor] = {
    (make, model): sensor
    for make, models, sensor in (
        # 1/2.3 inch, 1.55 um: the published fields of view
        ("DJI", "FC300C FC300S FC300X FC330 FC350 FC220", Sensor(4000, 3000, 6.2, 0.02)),
        ("DJI", "FC6310 FC6310S FC6310R", Sensor(5472, 3648, 13.2, 0.015)),
        ("HASSELBLAD", "L1D-20C", Sensor(5472, 3648, 13.2, 0.015)),
        ("DJI", "L2D-20C M3E FC6520", Sensor(5280, 3956, 17.3, 0.02)),
        ("HASSELBLAD", "L2D-20C", Sensor(5280, 3956, 17.3, 0.02)),
        ("DJI", "FC550", Sensor(4608, 3456, 17.3, 0.02)),
        ("DJI", "FC6540", Sensor(6016, 4008, 23.5, 0.02)),
        ("DJI", "ZENMUSEP1", Sensor(8192, 5460, 35.9, 0.01)),
        ("DJI", "FC2204 FC7203 FC7303", Sensor(4000, 3000, None, 0.03)),
        ("DJI", "FC1102", Sensor(3968, 2976, None, 0.03)),
        ("DJI", "FC2103", Sensor(4056, 3040, None, 0.03)),
        ("DJI", "FC3170", Sensor(8000, 6000, None, 0.03)),
        ("DJI", "FC3411", Sensor(5472, 3648, None, 0.03)),
        ("DJI", "FC3582 FC3682 FC8482", Sensor(8064, 6048, None, 0.03)),
        ("SENSEFLY", "S.O.D.A.", Sensor(5472, 3648, 12.75, 0.02)),
    )
    for model in models.split()
}
"""By maker and model as EXIF has them, without the maker's name. Sizes by the makers'
specifications; widths were compared with their fields of view (docs/flights.md)."""


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
    longer_px, shorter_px = max(width_px, height_px), min(width_px, height_px)
    found = _found(optics, longer_px, shorter_px, sensor_width_mm) or _of_plane(
        optics, width_px, longer_px
    )
    if found is None or not math.isfinite(found.px):
        return None
    field_deg = found.field_deg(longer_px)
    if field_deg > MAX_FIELD_DEG:
        raise CameraError(
            f"focal length implies a field of view of {field_deg:.0f} deg; give --camera FILE"
        )
    return found


def _found(
    optics: Optics, longer_px: int, shorter_px: int, sensor_width_mm: float | None
) -> FocalLength | None:
    """By the sensor or the 35 mm equivalent. EXIF rounds focal lengths to 1 or 2 digits: 2 to 3 %.

    Pictures of 16:9 are taken as parts of a sensor of 4:3; whether they are makes 9 %.
    """
    if sensor_width_mm is not None and optics.focal_mm > 0:
        px = optics.focal_mm / sensor_width_mm * longer_px
        return FocalLength(px, 0.02, "EXIF and --sensor-width-mm")
    make = optics.make.upper()
    sensor = _SENSORS.get((make, optics.model.upper().removeprefix(f"{make} ")))
    if sensor is not None:
        px = _film_px(optics.film_mm, sensor.width_px, sensor.height_px)
        if sensor.width_mm is not None:
            px = optics.focal_mm / sensor.width_mm * sensor.width_px
        px *= max(longer_px / sensor.width_px, shorter_px / sensor.height_px)
        if px > 0:
            return FocalLength(px, sensor.std, f"EXIF, and the sensor of {optics.model}")
    if not optics.film_mm > 0:
        return None
    source = "35 mm equivalent of EXIF"
    if longer_px / shorter_px < 1.65:
        return FocalLength(_film_px(optics.film_mm, longer_px, shorter_px), 0.03, source)
    px = _film_px(optics.film_mm, longer_px, longer_px * 3 / 4)
    return FocalLength(px, 0.06, f"{source}, of an uncropped 4:3 sensor")


def _film_px(film_mm: float, width_px: float, height_px: float) -> float:
    """Focal length of a picture by its equivalent on film of 36 x 24 mm, by the diagonals."""
    return film_mm / math.hypot(36.0, 24.0) * math.hypot(width_px, height_px)


def _of_plane(optics: Optics, width_px: int, longer_px: int) -> FocalLength | None:
    """Of the resolution of the sensor. Some cameras write its width there instead."""
    unit_mm = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}.get(optics.plane_unit, math.nan)
    thinned = width_px / (optics.taken_px if optics.taken_px > 0 else width_px)
    px = optics.focal_mm * optics.plane / unit_mm * thinned
    if not px > 0:
        return None
    found = FocalLength(px, 0.03, "focal length and sensor resolution of EXIF")
    px = optics.focal_mm / (optics.plane * unit_mm) * width_px
    other = FocalLength(px, 0.03, "EXIF, with the sensor's width instead of its resolution")
    wide, other_wide = (each.field_deg(longer_px) > MAX_FIELD_DEG for each in (found, other))
    return other if wide and not other_wide else found


_VALUE = re.compile(
    r"(?<![/\w-])([A-Za-z][\w-]{0,20}:[A-Za-z0-9]+)\s*(?:=\s*[\"']|>)\s*"
    r"([^\"'<\s][^\"'<]{0,300}?)\s*[\"'<]"
)
_NUMBER = re.compile(r"([-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d{1,2})?)(?:\s*/\s*(\d+(?:[.,]\d+)?))?")
"""A number with a decimal point or comma, or a fraction."""
_ANGLE_OR_PLACE = re.compile(
    r"(?:drone(?:-dji)?|Camera|sensefly|skydio|drone-parrot):(?:Gimbal|Flight(?:Yaw|Pitch|Roll)|"
    r"(?:Camera)?(?:Yaw|Pitch|Roll)|Heading|Altitude|Height|Lat|Lon)"
)
"""Values that a view is worse off without."""
_SKYDIO = re.compile(r"(?s)(drone-skydio:CameraOrientationNED\b)(?:[^<>]{0,600}/>|.{0,600}?</\1)")


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
    turned: bool  # whether other programs show it turned, by the orientation of EXIF
    software: str  # programs that wrote the file; of a camera its firmware
    agl_m: float = math.nan  # height above ground, where a table states it
    doubts: tuple[str, ...] = ()
    """Values that are there and cannot be used: what is wrong with each."""
    order: int = 0  # number of its row in a table
    pose: Mapping[str, Any] = field(default_factory=dict)
    """Its attitude as fields of `Telemetry`: by a table, or once all of the flight are known."""


def read_photo(path: Path) -> Photo:
    """Metadata of the photograph at `path`; the image is not decoded."""
    pillow, names = needed("PIL.Image", "photographs"), needed("PIL.ExifTags", "photographs")
    with reading("photograph", path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about large images and odd tags
        with pillow.open(path) as image:
            exif = image.getexif()
            # Some thermal cameras have XMP in the Exif directory.
            tags = _named(exif, names.TAGS) | _named(exif.get_ifd(names.IFD.Exif), names.TAGS)
            gps = _named(exif.get_ifd(names.IFD.GPSInfo), names.GPSTAGS)
            packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp")
            width, height = image.size
    xmp = Xmp(packet or tags.get("XMLPacket") or b"")
    make, notes = _word(tags.get("Make")), tags.get("MakerNote")
    gimbal, heading = read_maker_notes(notes if isinstance(notes, bytes) else b"", make)
    time_ns, zone_known = (xmp.time_ns, True) if xmp.time_ns else _time(tags)
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
        others += ["GPSImgDirection"] if "GPSImgDirection" in gps else []
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
        optics=_optics(tags),
        lens=xmp.lens if xmp.first("drone-dji:DewarpFlag") == 0 else None,
        turned=tags.get("Orientation", 1) not in (0, 1),
        software=", ".join(filter(None, dict.fromkeys((_word(tags.get("Software")), xmp.writer)))),
        doubts=tuple(filter(None, (*doubts, void, doubt))),
    )


def _named(tags: Mapping[int, Any], names: Mapping[int, str]) -> dict[str, Any]:
    """Values by the names of their tags; tags are decoded on access."""
    return {names[tag]: tags[tag] for tag in list(tags) if tag in names}


def _optics(tags: Mapping[str, Any]) -> Optics:
    unit = _number(tags.get("FocalPlaneResolutionUnit") or 2)
    return Optics(
        make=_word(tags.get("Make")),
        model=_word(tags.get("Model")),
        focal_mm=_number(tags.get("FocalLength")),
        film_mm=_number(tags.get("FocalLengthIn35mmFilm")),
        plane=_number(tags.get("FocalPlaneXResolution")),
        plane_unit=int(unit) if math.isfinite(unit) else 0,
        taken_px=_number(tags.get("ExifImageWidth")),
        zoom=_number(tags.get("DigitalZoomRatio")),
    )


def _word(value: Any) -> str:
    text = value.decode("latin-1") if isinstance(value, bytes) else value
    return "" if value is None else str(text).strip("\0 ")


def _time(tags: Mapping[str, Any]) -> tuple[int | None, bool]:
    """Time in ns by the camera's clock, and whether it is UTC, by `OffsetTimeOriginal`."""
    kind = "Original" if _word(tags.get("DateTimeOriginal")).strip(" :") else ""
    text, fraction, zone = (
        _word(tags.get(f"{name}{kind}")) for name in ("DateTime", "SubsecTime", "OffsetTime")
    )
    zone = zone if re.fullmatch(r"Z|[+-][01]\d:?[0-5]\d", zone) else ""
    nanoseconds = int(fraction[:9].ljust(9, "0")) if fraction.isdecimal() else 0
    try:
        moment = datetime.strptime(text + zone, "%Y:%m:%d %H:%M:%S" + "%z" * bool(zone))
        return ns_of(moment) + nanoseconds, bool(zone)
    except ValueError:
        return None, False


def _gps_time_ns(gps: Mapping[str, Any]) -> int | None:
    try:
        day = datetime.strptime(_word(gps["GPSDateStamp"]), "%Y:%m:%d").replace(tzinfo=UTC)
        hours, minutes, seconds = (float(part) for part in gps["GPSTimeStamp"])
        return round((day.timestamp() + hours * 3600 + minutes * 60 + seconds) * 1e9)
    except (KeyError, ValueError, TypeError, ZeroDivisionError, OverflowError):
        return None


def _place(gps: Mapping[str, Any]) -> tuple[tuple[float, float] | None, float, str]:
    """Latitude and longitude in degrees, altitude, and why there is none."""
    below = gps.get("GPSAltitudeRef") in (1, 3, b"\x01", b"\x03")
    alt = measured(_number(gps.get("GPSAltitude")) * (-1 if below else 1))
    try:
        lat, lon = (
            sum(float(part) / 60**i for i, part in enumerate(gps[f"GPS{name}"]))
            for name in ("Latitude", "Longitude")
        )
    except (KeyError, ValueError, TypeError, ZeroDivisionError):
        return None, alt, ""
    north, east = (_word(gps.get(f"GPS{x}Ref")).upper()[:1] for x in ("Latitude", "Longitude"))
    if north not in tuple("NS") or east not in tuple("EW"):
        return None, alt, "GPS position without N or S, or without E or W"
    lat, lon = -lat if north == "S" else lat, -lon if east == "W" else lon
    sound = abs(lat) <= 90 and abs(lon) <= 360 and (lat, lon) != (0.0, 0.0)
    return ((lat, lon) if sound else None), alt, ""


def _void(gps: Mapping[str, Any]) -> str:
    """Why the receiver's values are not used, empty where they are."""
    if _word(gps.get("GPSStatus")).upper() == "V" or _word(gps.get("GPSMeasureMode")) == "0":
        return "GPS position without a fix (GPSStatus, GPSMeasureMode)"
    if _number(gps.get("GPSHPositioningError")) > 100.0 or _number(gps.get("GPSDOP")) > 20.0:
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
        if values or not 1 <= count <= 100 or len(data) < 2 + count * 12:
            continue
        for tag, kind, size, value in struct.iter_unpack(f"{order}HHIf", data[2 : 2 + count * 12]):
            if (kind, size) == (11, 1) and abs(value) <= 360:  # one float
                values[tag] = value
    yaw, pitch, roll = (values.get(tag, math.nan) for tag in (10, 9, 11))
    known = math.isfinite(yaw + pitch + roll)
    return (yaw, pitch, roll) if known else None, values.get(7, math.nan)


class Xmp:
    """The values of a packet by prefix and name, and what they mean; NaN and None for missing.

    `time_ns`: UTC at exposure. `writer`: program that wrote the packet. `lens`: see `Photo`.
    `unread`: angles, heights and positions that are not numbers, as name and value.
    """

    def __init__(self, packet: str | bytes) -> None:
        text = packet.decode("utf-8", errors="replace") if isinstance(packet, bytes) else packet
        camera = _SKYDIO.search(text)  # its names are those of the aircraft's angles too
        skydio = camera[0].replace("drone-skydio:", "skydio:") if camera else ""
        texts = dict(_VALUE.findall(skydio + text))
        found = {name: _stated(value) for name, value in texts.items()}
        self.values = {name: value for name, value in found.items() if math.isfinite(value)}
        self.unread = tuple(
            f"{name}={texts[name]!r:.40}"
            for name in found.keys() - self.values.keys()
            if _ANGLE_OR_PLACE.match(name)
        )
        exposed = texts.get("drone-dji:UTCAtExposure") or texts.get("sensefly:UTCTime", "")
        self.time_ns = _exposed_ns(exposed)
        writer = re.search(r"\bxmp:CreatorTool\s*(?:=\s*[\"']|>)\s*([^\"'<]{1,200})", text)
        self.writer = writer[1].strip() if writer else ""
        self.lens = _lens(texts.get("drone-dji:DewarpData", ""))

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
    """DJI's calibration, which follows its date."""
    try:
        found = tuple(map(float, text.rpartition(";")[2].split(",")))
    except ValueError:
        return None
    return found if len(found) == 9 and all(map(math.isfinite, found)) else None


def _stated(text: str) -> float:
    found = _NUMBER.fullmatch(text)
    if found is None:
        return math.nan
    over, under = (float((part or "1").replace(",", ".")) for part in found.groups())
    return over / under if under else math.nan


def _exposed_ns(text: str) -> int | None:
    try:
        return ns_of(moment_of(text))
    except ValueError:
        return None
