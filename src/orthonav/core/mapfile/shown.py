"""A map for other programs: its outline as GeoJSON, its imagery as a georeferenced picture."""

import json
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import OutputError, UsageError
from orthonav.core.files import replacing, write_text
from orthonav.core.mapfile.layer import GreyLayer, preview
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.mapfile.reader import MapFile

Grey = NDArray[np.uint8]


def write_preview(opened: MapFile, path: Path) -> None:
    """Imagery of the first sheet as grey PNG or TIFF, with GDAL's `.aux.xml` beside it; 0: none.

    Raises `OutputError` for another ending, `MapFileError` where the map is damaged."""
    path = Path(path)
    if path.suffix.lower() not in (".png", ".tif", ".tiff"):
        raise UsageError(f"preview must be a .png or .tif file: {path}")
    grey, px_m, sheet = _picture(opened, 4096)
    done, data = cv2.imencode(path.suffix.lower(), grey)
    if not done:
        raise OutputError(f"the picture cannot be encoded: {path}")
    with replacing(path) as temporary:
        temporary.write_bytes(data.tobytes())
    write_text(path.with_name(f"{path.name}.aux.xml"), _georeference(sheet, px_m))


def footprint_geojson(opened: MapFile) -> str:
    """The area with imagery as GeoJSON (RFC 7946); without a layer the rectangle of the tiles."""
    grey, px_m, sheet = _picture(opened, 1024)
    shown, finer = (grey > 0).astype(np.uint8), 4  # outlines run through the middles of pixels
    fine = shown.repeat(finer, axis=0).repeat(finer, axis=1)
    lines, nesting = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    parts: dict[int, list[Any]] = {}
    for holes in (False, True):
        for number, line in enumerate(lines):
            around = int(nesting[0, number, 3])  # the line that this is a hole of; -1: none
            simple = cv2.approxPolyDP(line, finer, True)[:, 0]
            if len(simple) < 3 or (around >= 0) != holes or (holes and around not in parts):
                continue
            ring = _ring(simple, px_m / finer, sheet, outer=not holes)
            parts.setdefault(around if holes else number, []).append(ring)
    several = list(parts.values())
    geometry = {"type": "MultiPolygon", "coordinates": several}
    if len(several) == 1:
        geometry = {"type": "Polygon", "coordinates": several[0]}
    about = {"map": opened.path.name, "gsd_m": sheet.grid.gsd_m}
    feature = {"type": "Feature", "properties": about, "geometry": geometry}
    return json.dumps({"type": "FeatureCollection", "features": [feature]}) + "\n"


def _picture(opened: MapFile, most_px: int) -> tuple[Grey, NDArray[np.float64], SheetInfo]:
    """Grey levels of the first sheet, 0 without imagery; width and height of a pixel in metres."""
    sheet = opened.manifest.sheets[0]
    grid, layer = sheet.grid, GreyLayer.of(opened)
    if layer is None:
        grey = np.maximum(preview(opened), 1)
        return (
            grey,
            np.array([grid.width_px, grid.height_px]) * grid.gsd_m / grey.shape[::-1],
            sheet,
        )
    levels = range(layer.levels)
    level = next((each for each in levels if max(layer.shape(each)) <= most_px), levels[-1])
    grey, valid = layer.read(level, 0, 0, *layer.shape(level))
    shown = np.where(valid, np.maximum(grey, 1), 0).astype(np.uint8)
    return shown, np.full(2, grid.gsd_m * 2.0**level), sheet


def _ring(line: NDArray[Any], px_m: NDArray[np.float64], sheet: SheetInfo, *, outer: bool) -> Any:
    """A closed line (N, 2) as longitudes and latitudes, counter-clockwise if `outer`."""
    corner = np.array([sheet.grid.west_m, sheet.grid.north_m])
    en_m = corner + (line + 0.5) * px_m * (1, -1)
    east, north = en_m.T
    area = float(np.sum(east * np.roll(north, -1) - np.roll(east, -1) * north))
    if (area > 0) != outer:
        en_m = en_m[::-1]
    lat, lon = sheet.frame.latlon_from_en(np.vstack([en_m, en_m[:1]]))
    return np.round(np.stack([lon, lat], axis=-1), 7).tolist()


def _georeference(sheet: SheetInfo, px_m: NDArray[np.float64]) -> str:
    """GDAL's file beside an image."""
    west_m, north_m = sheet.grid.west_m, sheet.grid.north_m
    transform = ", ".join(map(repr, map(float, (west_m, px_m[0], 0, north_m, 0, -px_m[1]))))
    return (
        f"<PAMDataset>\n<SRS>{escape(sheet.frame.wkt)}</SRS>\n"
        f"<GeoTransform>{transform}</GeoTransform>\n"
        '<PAMRasterBand band="1"><NoDataValue>0</NoDataValue></PAMRasterBand>\n</PAMDataset>\n'
    )
