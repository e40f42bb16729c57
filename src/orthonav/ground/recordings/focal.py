"""Focal length of photographs by their metadata, and how well it is known.

The 35 mm equivalent of drones belongs to the whole sensor, also where the picture is a part of it:
a 16:9 picture of a 4:3 sensor has the sensor's width, and the focal length in pixels of the 4:3
picture.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from orthonav.core.errors import CameraError

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
    """A focal length for pictures of one size."""

    px: float  # in pixels, above 0
    std: float  # its standard deviation, as a fraction of it
    source: str  # where it comes from, for people

    def field_deg(self, longer_px: int) -> float:
        """Field of view along a side of so many pixels."""
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
        return FocalLength(px, _GIVEN_STD, "EXIF and --sensor-width-mm")
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
    """Of the 35 mm equivalent, which compares diagonals (CIPA DCG-001)."""
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
    px = optics.focal_mm * optics.plane / unit_mm * thinned
    if not px > 0:
        return None
    source = "focal length and sensor resolution of EXIF"
    found = FocalLength(px, _PLANE_STD, source)
    if found.field_deg(max(width_px, height_px)) <= MAX_FIELD_DEG:
        return found
    as_width = FocalLength(
        optics.focal_mm / (optics.plane * unit_mm) * width_px,
        _PLANE_STD,
        "EXIF, with the sensor's width instead of its resolution",
    )
    believed = as_width.field_deg(max(width_px, height_px)) <= MAX_FIELD_DEG
    return as_width if believed else found
