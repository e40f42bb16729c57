"""XMP of photographs by DJI, Autel, senseFly and Pix4D.

Values are searched by the manufacturers' names in the text of the packet: some firmware writes
undeclared prefixes, which no XML parser accepts. Conventions of angles: `docs/flights.md`.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from orthonav.core.flight.telemetry_track import measured
from orthonav.core.geo.camera import enu_from_camera

_VALUE = re.compile(
    r"(?<![/\w-])(drone-dji|drone|Camera|sensefly):([A-Za-z0-9]+)\s*(?:=\s*[\"']|>)\s*"
    r"([^\"'<\s][^\"'<]{0,60}?)\s*[\"'<]"
)
_NUMBER = re.compile(r"([-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d{1,2})?)(?:\s*/\s*(\d+(?:[.,]\d+)?))?")
"""A number with a decimal point or comma, or a fraction."""
_ANGLE_OR_PLACE = re.compile(
    r"Gimbal|Flight(?:Yaw|Pitch|Roll)|Yaw|Pitch|Roll|Heading|Altitude|Height|Lat|Lon"
)
"""Values that a view is worse off without."""
_EXPOSED = re.compile(
    r"\b(?:drone-dji:UTCAtExposure|sensefly:UTCTime)\s*(?:=\s*[\"']|>)\s*"
    r"(\d{4})[-:](\d\d)[-:](\d\d)[T ](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?"
)
_WRITER = re.compile(r"\bxmp:CreatorTool\s*(?:=\s*[\"']|>)\s*([^\"'<]{1,200})")


@dataclass(frozen=True)
class Xmp:
    """The values of a packet by prefix and name, and what they mean; NaN and None for missing."""

    values: Mapping[str, float]
    time_ns: int | None
    """UTC at exposure."""
    writer: str
    """Program that wrote the packet, empty where it is not named."""
    unread: tuple[str, ...] = ()
    """Angles, heights and positions that are not numbers, as name and value."""

    @classmethod
    def of(cls, packet: str | bytes) -> "Xmp":
        """The values in a packet, which may be empty."""
        text = packet.decode("utf-8", errors="replace") if isinstance(packet, bytes) else packet
        texts = {f"{maker}:{name}": value for maker, name, value in _VALUE.findall(text)}
        found = {name: _number(value) for name, value in texts.items()}
        values = {name: value for name, value in found.items() if math.isfinite(value)}
        unread = tuple(
            f"{name}={texts[name]!r:.40}"
            for name in found.keys() - values.keys()
            if _ANGLE_OR_PLACE.match(name.partition(":")[2])
        )
        writer = _WRITER.search(text)
        return cls(values, _exposed_ns(text), writer[1].strip() if writer else "", unread)

    def first(self, *names: str) -> float:
        """The first of these values that is there, else NaN."""
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
        return self._angles("drone-dji:Gimbal{}Degree") or self._angles("drone:Gimbal{}Degree")

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
        if angles is None:
            return None
        # senseFly uses the names of Pix4D with the opposite sign of roll.
        yaw, pitch, roll = angles
        return enu_from_camera(yaw, pitch, -roll if "sensefly" in make.lower() else roll)

    def velocity_en_mps(self) -> tuple[float, float] | None:
        """Velocity over ground, east and north."""
        north, east = (
            self.first(f"drone-dji:Flight{axis}Speed", f"drone:Flight{axis}Speed") for axis in "XY"
        )
        return (east, north) if math.isfinite(east + north) else None

    def home_m(self) -> float:
        """Height above the place of take-off."""
        return measured(
            self.first("drone-dji:RelativeAltitude", "drone:RelativeAltitude", "sensefly:Height")
        )

    def hae_m(self) -> float:
        """Height above the ellipsoid: of RTK, or as senseFly writes it."""
        if self.first("drone-dji:RtkFlag") > 0:
            return self.first("drone-dji:AbsoluteAltitude")
        return self.first("sensefly:AltitudeWGS84")

    def _angles(self, pattern: str) -> tuple[float, float, float] | None:
        yaw, pitch, roll = (self.first(pattern.format(name)) for name in ("Yaw", "Pitch", "Roll"))
        return (yaw, pitch, roll) if math.isfinite(yaw + pitch + roll) else None


def _number(text: str) -> float:
    """The number in a text, NaN where it is none."""
    found = _NUMBER.fullmatch(text)
    if found is None:
        return math.nan
    over, under = (float((part or "1").replace(",", ".")) for part in found.groups())
    return over / under if under else math.nan


def _exposed_ns(text: str) -> int | None:
    """UTC in ns at exposure, as survey cameras of DJI and senseFly write it."""
    found = _EXPOSED.search(text)
    if found is None:
        return None
    try:
        year, month, day, hour, minute, second = map(int, found.groups()[:6])
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    return round(whole.timestamp()) * 10**9 + int((found[7] or "0").ljust(9, "0"))
