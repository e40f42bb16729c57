"""Camera positions of a flight for other programs: tables, maps, photogrammetry, trajectories.

Only confident positions are written: photogrammetry takes what it is given as measured.
"""

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from orthonav.core.errors import VariantError
from orthonav.core.files import write_text
from orthonav.core.geo.attitude import wxyz_of_matrices
from orthonav.core.geo.camera import enu_from_camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import TerrainHeights
from orthonav.core.records import MAP_STD_M, Fix, ViewResult

_XML = '<?xml version="1.0" encoding="UTF-8"?>\n'
_YEAR_2000_NS = 946_684_800 * 10**9  # earlier times count from something else than 1970
CSV_COLUMNS = ("frame", "lat_deg", "lon_deg", "height_m", "agl_m", "heading_deg", "std_m")


@dataclass(frozen=True, eq=False)
class CameraPosition:
    """Where a picture was taken: a view and its confident fix.

    `height_m`: above mean sea level, NaN without a terrain. `std_m`: standard deviation of the
    position along its worst axis, the displacement of the map included. `above_sea`: whether all
    heights of the flight are known. `en_m`: metres east and north of the first position.
    """

    view: ViewResult
    fix: Fix
    height_m: float
    std_m: float
    above_sea: bool = False
    en_m: tuple[float, float] = (0.0, 0.0)

    @property
    def up_m(self) -> float:
        """Height above sea where all are known, else above ground."""
        return self.height_m if self.above_sea else self.fix.agl_m


def camera_positions(
    results: Sequence[ViewResult], terrain: TerrainHeights | None
) -> list[CameraPosition]:
    """The confident positions of a flight; heights above sea by the ground of `terrain`."""
    found: list[CameraPosition] = []
    for view in results:
        fix = view.outcome
        if not isinstance(fix, Fix) or not view.is_confident:
            continue
        ground_m = math.nan
        if terrain is not None:
            ground_m = float(terrain(np.array([fix.lat_deg]), np.array([fix.lon_deg]))[0])
        worst = max(float(np.linalg.eigvalsh(fix.cov_en_m2)[-1]), 0.0)
        if view.state is None:  # that of a track has it already
            worst += MAP_STD_M**2
        found.append(CameraPosition(view, fix, ground_m + fix.agl_m, math.sqrt(worst)))
    if not found:
        return found
    above_sea = all(math.isfinite(each.height_m) for each in found)
    plane = LocalFrame(found[0].fix.lat_deg, found[0].fix.lon_deg)
    return [
        replace(
            each,
            above_sea=above_sea,
            en_m=tuple(plane.en_from_latlon(each.fix.lat_deg, each.fix.lon_deg).tolist()),
        )
        for each in found
    ]


def export_of(text: str) -> tuple[str, Path]:
    name, _, path = text.partition("=")
    if name not in FORMATS or not path:
        raise VariantError(
            f"an export is one of {', '.join(FORMATS)} with a path, such as odm-geo=geo.txt, "
            f"got '{text}'"
        )
    return name, Path(path)


def export_all(
    exports: Sequence[tuple[str, Path]],
    results: Sequence[ViewResult],
    terrain: TerrainHeights | None,
) -> None:
    """Write the camera positions of a flight in formats and to paths of `export_of`."""
    positions = camera_positions(results, terrain) if exports else []
    for name, path in exports:
        head, line_of, tail = FORMATS[name]
        write_text(path, "\n".join([head, *map(line_of, positions), *tail]) + "\n")


def _csv(each: CameraPosition) -> str:
    values = each.height_m, each.fix.agl_m, each.fix.heading_deg, each.std_m
    known = ("" if math.isnan(value) else f"{value:.3f}" for value in values)
    out = io.StringIO()
    csv.writer(out, lineterminator="").writerow(
        [each.view.frame, f"{each.fix.lat_deg:.8f}", f"{each.fix.lon_deg:.8f}", *known]
    )
    return out.getvalue()


def _odm_geo(each: CameraPosition) -> str:
    """A line of OpenDroneMap's image geolocation file, https://docs.opendronemap.org/geo.

    Accuracy follows angles, and angles follow the height: without a height it is left out. Angles
    are 0, which means not available. Names must have no spaces.
    """
    if any(character.isspace() for character in each.view.frame):
        raise VariantError(f"OpenDroneMap takes no file names with spaces: {each.view.frame!r}")
    line = f"{each.view.frame} {each.fix.lon_deg:.8f} {each.fix.lat_deg:.8f}"
    if math.isnan(each.height_m):
        return line
    return f"{line} {each.height_m:.3f} 0 0 0 {each.std_m:.3f}"


def _tum(each: CameraPosition) -> str:
    """A pose as evo reads it: `timestamp tx ty tz qx qy qz qw`, metres and a quaternion.

    The quaternion turns camera axes (x to the right of the image, y down the image, z along the
    optical axis) to east, north and up. Unknown angles count as 0.
    """
    angles = np.nan_to_num([each.fix.heading_deg, each.fix.pitch_deg, each.fix.roll_deg])
    w, *xyz = wxyz_of_matrices(enu_from_camera(*angles.tolist())).tolist()
    numbers = " ".join(f"{math.copysign(1, w) * value:.9f}" for value in (*xyz, w))
    place = f"{each.en_m[0]:.4f} {each.en_m[1]:.4f} {each.up_m:.4f}"
    return f"{Decimal(each.view.time_ns).scaleb(-9):f} {place} {numbers}"


def _kml(each: CameraPosition) -> str:
    mode = "absolute" if each.above_sea else "relativeToGround"
    return (
        f"<Placemark><name>{escape(each.view.frame)}</name>"
        f"<description>std {each.std_m:.1f} m</description>"
        f"<Point><altitudeMode>{mode}</altitudeMode><coordinates>"
        f"{each.fix.lon_deg:.8f},{each.fix.lat_deg:.8f},{each.up_m:.2f}"
        "</coordinates></Point></Placemark>"
    )


def _gpx(each: CameraPosition) -> str:
    """A point of a track (GPX 1.1); with height above sea and date where they are known."""
    height = f"<ele>{each.height_m:.2f}</ele>" if math.isfinite(each.height_m) else ""
    time = ""
    if each.view.time_ns >= _YEAR_2000_NS:
        whole = datetime.fromtimestamp(each.view.time_ns // 10**9, UTC)
        milliseconds = each.view.time_ns % 10**9 // 10**6
        time = f"<time>{whole:%Y-%m-%dT%H:%M:%S}.{milliseconds:03d}Z</time>"
    place = f'lat="{each.fix.lat_deg:.8f}" lon="{each.fix.lon_deg:.8f}"'
    return f"<trkpt {place}>{height}{time}<name>{escape(each.view.frame)}</name></trkpt>"


FORMATS: dict[str, tuple[str, Callable[[CameraPosition], str], tuple[str, ...]]] = {
    "csv": (",".join(CSV_COLUMNS), _csv, ()),
    "odm-geo": ("EPSG:4326", _odm_geo, ()),
    "tum": ("# east, north, up (m) of the first position", _tum, ()),
    "kml": (
        f'{_XML}<kml xmlns="http://www.opengis.net/kml/2.2"><Document>',
        _kml,
        ("</Document></kml>",),
    ),
    "gpx": (
        f'{_XML}<gpx version="1.1" creator="orthonav" xmlns="http://www.topografix.com/GPX/1/1">'
        "<trk><trkseg>",
        _gpx,
        ("</trkseg></trk></gpx>",),
    ),
}
"""First line, a line for each position, and last line, by the name of the format."""
