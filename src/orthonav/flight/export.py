"""Camera positions of a flight for other programs: CSV, GeoJSON, OpenDroneMap, ExifTool.

Only confident positions are written: photogrammetry takes what it is given as measured.
"""

import csv
import io
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from orthonav.errors import VariantError
from orthonav.files import write_text
from orthonav.geo.ground import TerrainHeights
from orthonav.records import MAP_STD_M, Fix, ViewResult

CSV_COLUMNS = ("frame", "lat_deg", "lon_deg", "height_m", "agl_m", "heading_deg", "std_m")


@dataclass(frozen=True)
class CameraPosition:
    """Where a picture was taken.

    `lat_deg`, `lon_deg`: WGS84. `height_m`: above mean sea level, NaN without a terrain. `agl_m`:
    above ground. `heading_deg`: of the top of the picture, clockwise from north. `std_m`: standard
    deviation of the position along its worst axis, the displacement of the map included.
    `confidence`: probability in 0..1.
    """

    frame: str
    lat_deg: float
    lon_deg: float
    height_m: float
    agl_m: float
    heading_deg: float
    std_m: float
    confidence: float


def camera_positions(
    results: Sequence[ViewResult], terrain: TerrainHeights | None
) -> list[CameraPosition]:
    """The confident positions of a flight; heights above sea by the ground of `terrain`."""
    found = []
    for result in results:
        fix = result.outcome
        if not isinstance(fix, Fix) or not result.is_confident:
            continue
        ground_m = math.nan
        if terrain is not None:
            ground_m = float(terrain(np.array([fix.lat_deg]), np.array([fix.lon_deg]))[0])
        worst = max(float(np.linalg.eigvalsh(fix.cov_en_m2)[-1]), 0.0)
        if result.state is None:  # that of a track has it already
            worst += MAP_STD_M**2
        found.append(
            CameraPosition(
                result.frame,
                fix.lat_deg,
                fix.lon_deg,
                ground_m + fix.agl_m,
                fix.agl_m,
                fix.heading_deg,
                math.sqrt(worst),
                fix.confidence,
            )
        )
    return found


def export_of(text: str) -> tuple[str, Path]:
    """Format and path of `FORMAT=PATH`; raises `VariantError`."""
    name, _, path = text.partition("=")
    if name not in FORMATS or not path:
        raise VariantError(
            f"an export is one of {', '.join(FORMATS)} with a path, such as odm-geo=geo.txt, "
            f"got '{text}'"
        )
    return name, Path(path)


def export(path: Path, name: str, positions: Sequence[CameraPosition]) -> None:
    """Write positions in the format `name`, replacing an existing file atomically."""
    write_text(path, FORMATS[name](positions))


def export_all(
    exports: Sequence[tuple[str, Path]],
    results: Sequence[ViewResult],
    terrain: TerrainHeights | None,
) -> None:
    """Write the camera positions of a flight in formats and to paths of `export_of`."""
    positions = camera_positions(results, terrain) if exports else []
    for name, path in exports:
        export(path, name, positions)


def _csv(positions: Sequence[CameraPosition]) -> str:
    rows = [
        [
            each.frame,
            f"{each.lat_deg:.8f}",
            f"{each.lon_deg:.8f}",
            *(
                "" if math.isnan(value) else f"{value:.3f}"
                for value in (each.height_m, each.agl_m, each.heading_deg, each.std_m)
            ),
        ]
        for each in positions
    ]
    return _table([CSV_COLUMNS, *rows])


def _geojson(positions: Sequence[CameraPosition]) -> str:
    """Points (RFC 7946), with heights above sea where they are known."""
    features = []
    for each in positions:
        point = [round(each.lon_deg, 8), round(each.lat_deg, 8)]
        if not math.isnan(each.height_m):
            point.append(round(each.height_m, 3))
        about: dict[str, Any] = {
            "frame": each.frame,
            "agl_m": round(each.agl_m, 3),
            "heading_deg": round(each.heading_deg, 3),
            "std_m": round(each.std_m, 3),
            "confidence": round(each.confidence, 4),
        }
        about = {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in about.items()
        }
        geometry = {"type": "Point", "coordinates": point}
        features.append({"type": "Feature", "geometry": geometry, "properties": about})
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"


def _odm_geo(positions: Sequence[CameraPosition]) -> str:
    """OpenDroneMap's image geolocation file, https://docs.opendronemap.org/geo.

    Accuracy follows angles, and angles follow the height: without a height it is left out. Angles
    are 0, which means not available. Names must have no spaces.
    """
    lines = ["EPSG:4326"]
    for each in positions:
        if any(character.isspace() for character in each.frame):
            raise VariantError(f"OpenDroneMap takes no file names with spaces: {each.frame!r}")
        line = f"{each.frame} {each.lon_deg:.8f} {each.lat_deg:.8f}"
        if not math.isnan(each.height_m):
            line += f" {each.height_m:.3f} 0 0 0 {each.std_m:.3f}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def _exif(positions: Sequence[CameraPosition]) -> str:
    """A table that ExifTool writes into photographs (`exiftool -csv=TABLE FOLDER`)."""
    header = (
        *("SourceFile", "GPSLatitude", "GPSLatitudeRef", "GPSLongitude", "GPSLongitudeRef"),
        *("GPSAltitude", "GPSAltitudeRef", "GPSImgDirection", "GPSImgDirectionRef"),
        *("GPSHPositioningError", "GPSMapDatum"),
    )
    rows = []
    for each in positions:
        height = ["", ""]
        if not math.isnan(each.height_m):
            height = [
                f"{abs(each.height_m):.3f}",
                "Above Sea Level" if each.height_m >= 0 else "Below Sea Level",
            ]
        heading = ["", ""]
        if not math.isnan(each.heading_deg):
            heading = [f"{each.heading_deg:.2f}", "True North"]
        rows.append(
            [
                each.frame,
                f"{abs(each.lat_deg):.8f}",
                "North" if each.lat_deg >= 0 else "South",
                f"{abs(each.lon_deg):.8f}",
                "East" if each.lon_deg >= 0 else "West",
                *height,
                *heading,
                f"{each.std_m:.3f}",
                "WGS-84",
            ]
        )
    return _table([header, *rows])


def _table(rows: Sequence[Sequence[str]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


FORMATS: dict[str, Callable[[Sequence[CameraPosition]], str]] = {
    "csv": _csv,
    "geojson": _geojson,
    "odm-geo": _odm_geo,
    "exif": _exif,
}
"""Writers by the name of their format."""
