"""The ground below a check: the grey imagery of its map, coarse enough for a page."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.check.outcome import CheckResult
from orthonav.errors import MapFileError
from orthonav.mapfile.layer import GreyLayer, preview
from orthonav.mapfile.reader import MapFile
from orthonav.report import Background

MOST_PX, MOST_PX_IN_ALL = 2000, 2_600_000
"""Of the picture: on its long side, and altogether."""
MOST_BYTES = 1_300_000
_MARGIN = 0.04
_PAPER = 226
"""Grey where there is no imagery: the page lies light below it in the dark too."""
_MOST_READ_PX = 4096
_QUALITIES = (72, 60, 45, 30, 15)

Grey = NDArray[np.uint8]
Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Ground:
    """A grey picture (rows, cols), north up, of `box`: west, south, east, north in metres."""

    grey: Grey
    box: Box

    def jpeg(self) -> bytes:
        """It as JPEG, as good as `MOST_BYTES` allow."""
        for quality in _QUALITIES:
            done, data = cv2.imencode(".jpg", self.grey, [int(cv2.IMWRITE_JPEG_QUALITY), quality])
            if not done:
                raise MapFileError("the imagery of the map cannot be encoded")
            if data.size <= MOST_BYTES:
                break
        return bytes(data.tobytes())

    def background(self, most_px: int) -> Background:
        """It for a figure, no larger than `most_px` on its long side."""
        west_m, south_m, east_m, north_m = self.box
        return Background(_shrunk(self.grey, most_px), west_m, south_m, east_m, north_m)


def seen_box(result: CheckResult) -> Box:
    """What a map of the check shows: its cells and its route, with a margin; west, south, east,
    north in metres."""
    cells = result.cells
    rows, cols = np.nonzero(np.isfinite(cells.probability) | (cells.trials > 0))
    if not len(rows):
        rows, cols = np.array([0, cells.probability.shape[0] - 1]), np.array([0, 0])
        cols = np.array([0, cells.probability.shape[1] - 1])
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
    low, high = low - margin, high + margin
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def ground_below(opened: MapFile, box: Box) -> Ground:
    """The imagery of the first sheet in `box`, where it has any.

    Taken from the registration layer, or from the preview of a map without one. Raises
    `MapFileError` where these are damaged.
    """
    layer = GreyLayer.of(opened)
    return _preview(opened) if layer is None else _from_layer(opened, layer, box)


def _from_layer(opened: MapFile, layer: GreyLayer, box: Box) -> Ground:
    grid = opened.manifest.sheets[0].grid
    west, south, east, north = box
    sides_px = np.array([east - west, north - south]) / grid.gsd_m
    level = 0
    while level + 1 < layer.levels and sides_px.max() / 2 ** (level + 1) >= MOST_PX:
        level += 1
    gsd_m = grid.gsd_m * 2**level
    rows, cols = layer.shape(level)
    left, right = (
        int(np.clip(x, 0, cols))
        for x in (math.floor((west - grid.west_m) / gsd_m), math.ceil((east - grid.west_m) / gsd_m))
    )
    top, bottom = (
        int(np.clip(y, 0, rows))
        for y in (
            math.floor((grid.north_m - north) / gsd_m),
            math.ceil((grid.north_m - south) / gsd_m),
        )
    )
    right, bottom = max(right, left + 1), max(bottom, top + 1)
    grey = _read(layer, level, (top, left, bottom - top, right - left))
    west_m, north_m = grid.west_m + left * gsd_m, grid.north_m - top * gsd_m
    found = (west_m, grid.north_m - bottom * gsd_m, grid.west_m + right * gsd_m, north_m)
    return Ground(_shrunk(grey, MOST_PX), found)


def _read(layer: GreyLayer, level: int, window: tuple[int, int, int, int]) -> Grey:
    """A window (row, col, height, width) of a level, in strips where it is far too large."""
    row, col, height, width = window
    step = max(1, math.ceil(max(height, width) / _MOST_READ_PX))
    size = max(1, width // step), max(1, height // step)
    strips = []
    rows_at_once = 64 * step
    for top in range(0, height, rows_at_once):
        some = min(rows_at_once, height - top)
        grey, valid = layer.read(level, row + top, col, some, width)
        grey[~valid] = _PAPER
        if step > 1:
            grey = _resized(grey, (size[0], max(1, round(some / step))))
        strips.append(grey)
    return np.concatenate(strips)


def _shrunk(grey: Grey, most_px: int) -> Grey:
    rows, cols = grey.shape
    share = min(1.0, most_px / max(rows, cols), math.sqrt(MOST_PX_IN_ALL / (rows * cols)))
    return (
        grey
        if share == 1
        else _resized(grey, (max(1, round(share * cols)), max(1, round(share * rows))))
    )


def _resized(grey: Grey, size: tuple[int, int]) -> Grey:
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _preview(opened: MapFile) -> Ground:
    grid = opened.manifest.sheets[0].grid
    east_m = grid.west_m + grid.width_px * grid.gsd_m
    south_m = grid.north_m - grid.height_px * grid.gsd_m
    return Ground(preview(opened), (grid.west_m, south_m, east_m, grid.north_m))
