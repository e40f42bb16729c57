"""The grey imagery of a map as background of a check, coarse enough for a page."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import CheckResult
from orthonav.mapfile.layer import GreyLayer, preview
from orthonav.mapfile.reader import MapFile
from orthonav.report import Background

MAX_SIDE_PX, MAX_AREA_PX = 2000, 2_600_000
"""Limits of the image: its longer side, and its area."""
MAX_BYTES = 1_300_000
_MARGIN = 0.04
_EMPTY = 226
"""Grey level without imagery, as light as a light page."""
_QUALITIES = (72, 60, 45, 30, 15)

Grey = NDArray[np.uint8]
Box = tuple[float, float, float, float]


def jpeg(grey: Grey) -> bytes:
    """An image (rows, cols) as JPEG of the best quality within `MAX_BYTES`."""
    for quality in _QUALITIES:
        data = cv2.imencode(".jpg", grey, [int(cv2.IMWRITE_JPEG_QUALITY), quality])[1]
        if data.size <= MAX_BYTES:
            break
    return bytes(data.tobytes())


def visible_box(result: CheckResult) -> Box:
    """West, south, east, north in metres of cells and route, with a margin."""
    cells = result.cells
    rows, cols = np.nonzero(np.isfinite(cells.probability) | (cells.trials > 0))
    if not len(rows):
        height, width = cells.probability.shape
        rows, cols = np.array([0, height - 1]), np.array([0, width - 1])
    side = cells.side_m
    corners = [
        (cells.west_m + cols.min() * side, cells.north_m - (rows.max() + 1) * side),
        (cells.west_m + (cols.max() + 1) * side, cells.north_m - rows.min() * side),
    ]
    half_m = (result.band_m or 0.0) / 2
    if result.route_en_m is not None and len(result.route_en_m):
        corners += [tuple(result.route_en_m.min(0) - half_m)]
        corners += [tuple(result.route_en_m.max(0) + half_m)]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    margin = _MARGIN * float((high - low).max())
    west, south, east, north = (float(v) for v in (*(low - margin), *(high + margin)))
    return west, south, east, north


def map_image(opened: MapFile, box: Box) -> Background:
    """The imagery of the first sheet in `box`, from the registration layer or the preview.

    Raises `MapFileError` where these are damaged.
    """
    grid = opened.manifest.sheets[0].grid
    layer = GreyLayer.of(opened)
    west, south, east, north = box
    longest_px, level = max(east - west, north - south) / grid.gsd_m, 0
    while layer and level + 1 < layer.levels and longest_px >= 2 ** (level + 1) * MAX_SIDE_PX:
        level += 1
    if layer is None or longest_px > 2 ** (level + 2) * MAX_SIDE_PX:  # too few levels
        south_m = grid.north_m - grid.height_px * grid.gsd_m
        east_m = grid.west_m + grid.width_px * grid.gsd_m
        return Background(preview(opened), grid.west_m, south_m, east_m, grid.north_m)
    gsd_m = grid.gsd_m * 2**level
    rows, cols = layer.shape(level)
    left = int(np.clip(math.floor((west - grid.west_m) / gsd_m), 0, cols - 1))
    right = int(np.clip(math.ceil((east - grid.west_m) / gsd_m), left + 1, cols))
    top = int(np.clip(math.floor((grid.north_m - north) / gsd_m), 0, rows - 1))
    bottom = int(np.clip(math.ceil((grid.north_m - south) / gsd_m), top + 1, rows))
    grey, valid = layer.read(level, top, left, bottom - top, right - left)
    grey[~valid] = _EMPTY
    west_m, north_m = grid.west_m + left * gsd_m, grid.north_m - top * gsd_m
    east_m, south_m = grid.west_m + right * gsd_m, grid.north_m - bottom * gsd_m
    return Background(shrunk(grey, MAX_SIDE_PX), west_m, south_m, east_m, north_m)


def shrunk(grey: Grey, max_px: int) -> Grey:
    """An image no larger than `max_px` on its longer side and `MAX_AREA_PX`."""
    rows, cols = grey.shape
    share = min(1.0, max_px / max(rows, cols), math.sqrt(MAX_AREA_PX / (rows * cols)))
    if share == 1:
        return grey
    size = (max(1, round(share * cols)), max(1, round(share * rows)))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
