"""Camera positions of a flight for other programs: tables, maps, photogrammetry, trajectories.

Only confident positions are written: photogrammetry takes what it is given as measured.
"""

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from orthonav.core.errors import VariantError
from orthonav.core.files import write_text
from orthonav.core.flight.fixes import feature
from orthonav.core.geo.attitude import wxyz_of_matrices
from orthonav.core.geo.camera import enu_from_camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import TerrainHeights
from orthonav.core.records import MAP_STD_M, Fix, ViewResult

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
    above_sea: bool
    en_m: tuple[float, float]

    @property
    def up_m(self) -> float:
        """Height above sea where all are known, else above ground."""
        return self.height_m if self.above_sea else self.fix.agl_m


Positions = Sequence[CameraPosition]


def camera_positions(
    results: Sequence[ViewResult], terrain: TerrainHeights | None
) -> list[CameraPosition]:
    """The confident positions of a flight; heights above sea by the ground of `terrain`."""
    placed = [(v, v.outcome) for v in results if isinstance(v.outcome, Fix) and v.is_confident]
    if not placed:
        return []
    numbers = np.array([(fix.lat_deg, fix.lon_deg, fix.agl_m) for _, fix in placed])
    lat, lon, agl_m = numbers.T
    heights_m = agl_m + (math.nan if terrain is None else terrain(lat, lon))
    above_sea = bool(np.isfinite(heights_m).all())
    places_m = LocalFrame(*numbers[0, :2].tolist()).en_from_latlon(lat, lon)
    found = []
    for (view, fix), height_m, en_m in zip(placed, heights_m.tolist(), places_m, strict=True):
        worst = max(float(np.linalg.eigvalsh(fix.cov_en_m2)[-1]), 0.0)
        if view.state is None:  # that of a track has it already
            worst += MAP_STD_M**2
        place = float(en_m[0]), float(en_m[1])
        found.append(CameraPosition(view, fix, height_m, math.sqrt(worst), above_sea, place))
    return found


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
    """Write the camera positions of a flight in formats and to paths of `export_of`. Raises
    `VariantError` where a format cannot hold them, after the others are written."""
    positions = camera_positions(results, terrain) if exports else []
    refused: list[VariantError] = []
    for name, path in exports:
        try:
            write_text(path, "\n".join(FORMATS[name](positions)) + "\n")
        except VariantError as error:
            refused.append(error)
    if refused:
        raise refused[0]


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([columns, *rows])
    return out.getvalue().splitlines()


def _text(value: float, decimals: int = 3) -> str:
    return "" if math.isnan(value) else f"{value:.{decimals}f}"


def _csv(positions: Positions) -> list[str]:
    return _table(
        CSV_COLUMNS,
        (
            [
                *(each.view.frame, f"{each.fix.lat_deg:.8f}", f"{each.fix.lon_deg:.8f}"),
                *map(_text, (each.height_m, each.fix.agl_m, each.fix.heading_deg, each.std_m)),
            ]
            for each in positions
        ),
    )


def _geojson(positions: Positions) -> list[str]:
    features = [feature(x.view.frame, x.fix, x.std_m, x.height_m) for x in positions]
    return [json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False)]


def _exif(positions: Positions) -> list[str]:
    """A table that ExifTool writes into photographs (`exiftool -csv=TABLE FOLDER`)."""
    columns = [
        *("SourceFile", "GPSLatitude", "GPSLatitudeRef", "GPSLongitude", "GPSLongitudeRef"),
        *("GPSAltitude", "GPSAltitudeRef", "GPSImgDirection", "GPSImgDirectionRef"),
        *("GPSHPositioningError", "GPSMapDatum"),
    ]
    rows = []
    for each in positions:
        lat, lon, height_m = each.fix.lat_deg, each.fix.lon_deg, each.height_m
        heading = _text(each.fix.heading_deg, 2)
        level = f"{'Below' if height_m < 0 else 'Above'} Sea Level"
        rows.append(
            [
                *(each.view.frame, f"{abs(lat):.8f}", "North" if lat >= 0 else "South"),
                *(f"{abs(lon):.8f}", "East" if lon >= 0 else "West"),
                *(_text(abs(height_m)), "" if math.isnan(height_m) else level),
                *(heading, heading and "True North", _text(each.std_m), "WGS-84"),
            ]
        )
    return _table(columns, rows)


def _odm_geo(positions: Positions) -> list[str]:
    """OpenDroneMap's image geolocation file, https://docs.opendronemap.org/geo.

    Accuracy follows angles, and angles follow the height: without a height it is left out. Angles
    are 0, which means not available. Names must have no spaces.
    """
    lines = ["EPSG:4326"]
    for each in positions:
        if any(character.isspace() for character in each.view.frame):
            raise VariantError(
                f"OpenDroneMap takes no file names with spaces: {each.view.frame!r}; all other "
                "results are written"
            )
        height = "" if math.isnan(each.height_m) else f" {each.height_m:.3f} 0 0 0 {each.std_m:.3f}"
        lines.append(f"{each.view.frame} {each.fix.lon_deg:.8f} {each.fix.lat_deg:.8f}{height}")
    return lines


def _tum(positions: Positions) -> list[str]:
    """A trajectory as evo reads it: `timestamp tx ty tz qx qy qz qw`, metres and a quaternion.

    The quaternion turns camera axes (x to the right of the image, y down the image, z along the
    optical axis) to east, north and up. Unknown angles count as 0.
    """
    lines = [
        f"# east, north, up (m) of {each.fix.lat_deg:.8f}, {each.fix.lon_deg:.8f} (WGS84)"
        for each in positions[:1]
    ]
    for each in positions:
        angles = np.nan_to_num([each.fix.heading_deg, each.fix.pitch_deg, each.fix.roll_deg])
        w, *xyz = wxyz_of_matrices(enu_from_camera(*angles.tolist())).tolist()
        numbers = " ".join(f"{math.copysign(1, w) * value:.9f}" for value in (*xyz, w))
        place = f"{each.en_m[0]:.4f} {each.en_m[1]:.4f} {each.up_m:.4f}"
        lines.append(f"{Decimal(each.view.time_ns).scaleb(-9):f} {place} {numbers}")
    return lines


def _kml(positions: Positions) -> list[str]:
    """The track, and a place for each picture."""
    mode = "absolute" if any(each.above_sea for each in positions) else "relativeToGround"
    points = [f"{x.fix.lon_deg:.8f},{x.fix.lat_deg:.8f},{x.up_m:.2f}" for x in positions]
    marks = [("track", f"{len(points)} positions", "LineString", " ".join(points))]
    for each, point in zip(positions, points, strict=True):
        marks.append((escape(each.view.frame), f"std {each.std_m:.1f} m", "Point", point))
    return [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document>',
        *(
            f"<Placemark><name>{name}</name><description>{about}</description><{kind}>"
            f"<altitudeMode>{mode}</altitudeMode><coordinates>{coordinates}</coordinates>"
            f"</{kind}></Placemark>"
            for name, about, kind, coordinates in marks
        ),
        "</Document></kml>",
    ]


FORMATS: dict[str, Callable[[Positions], list[str]]] = {
    "csv": _csv,
    "geojson": _geojson,
    "kml": _kml,
    "tum": _tum,
    "odm-geo": _odm_geo,
    "exif": _exif,
}
"""Lines of a file by the name of its format."""
