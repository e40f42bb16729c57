"""What pages show of a map and of a view: tiles, crops, and rectified views.

Positions on a page are pixels of the sheet's finest level: fractional column and row from the
north-west corner of its raster (pixel-is-area).
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.geo.camera import (
    Camera,
    axis_on_ground_en_m,
    footprint_en_m,
)
from orthonav.core.localize.ground import FlatTerrain
from orthonav.core.localize.view import MAX_REACH, check_telemetry, downsampled, rectify
from orthonav.core.mapfile.layer import GreyLayer, preview
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.mapfile.terrain import SURFACE, TerrainLayer
from orthonav.core.records import Fix, Telemetry, View, ViewResult

MIN_PX, MAX_PX = 256, 1024
"""Limits of the pixels across a window: what a screen shows."""
MARGIN = 1.02
MAX_READ_PX = 4096
"""Limit of a window of the map, about 16 MB."""
Grey = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Box = tuple[float, float, float, float]
"""West, south, east, north in metres, in the plane of a sheet."""
_QUICK = [int(cv2.IMWRITE_PNG_COMPRESSION), 1]
_SMALL = [int(cv2.IMWRITE_WEBP_QUALITY), 70]


@dataclass(frozen=True)
class GroundWindow:
    """A square of ground, north up.

    `side_m`: its width; `size_px`: pixels across.
    `offset_en_m`: its middle, east and north of the point below the camera.
    """

    side_m: float
    size_px: int
    offset_en_m: tuple[float, float]

    def box_at(self, position_en_m: NDArray[np.float64]) -> Box:
        east, north = (float(value) for value in position_en_m + self.offset_en_m)
        half_m = self.side_m / 2
        return east - half_m, north - half_m, east + half_m, north + half_m


def as_fixed(telemetry: Telemetry, result: ViewResult) -> Telemetry:
    fix = result.outcome
    if not isinstance(fix, Fix):
        return telemetry
    pitch_deg, roll_deg = fix.tilt_deg(telemetry)
    return replace(
        telemetry,
        yaw_deg=fix.heading_deg if math.isfinite(fix.heading_deg) else telemetry.yaw_deg,
        agl_m=fix.agl_m if math.isfinite(fix.agl_m) else telemetry.agl_m,
        pitch_deg=pitch_deg,
        roll_deg=roll_deg,
    )


def window_of(telemetry: Telemetry, camera: Camera, gsd_m: float) -> GroundWindow:
    """The square that holds the footprint of a view. Raises `FlightError` where it is unknown.

    With a large tilt it is limited to `MAX_REACH` times the half side of a vertical view around the
    optical axis.
    """
    refused = check_telemetry(telemetry, camera, None, heading_known=True)
    if refused is not None:
        raise FlightError(refused.detail)
    attitude = telemetry.yaw_deg, telemetry.pitch_deg, telemetry.roll_deg, telemetry.agl_m
    axis = axis_on_ground_en_m(*attitude)
    reach_m = MAX_REACH * math.hypot(*camera.extent) / 2 * telemetry.agl_m
    try:
        corners = footprint_en_m(camera, *attitude)
        reach_m = min(reach_m, float(np.abs(corners - np.array(axis)).max()))
    except CameraError:
        pass  # the horizon is visible: keep the limit
    side_m = 2 * MARGIN * reach_m
    if not side_m < 1e6:
        raise FlightError(f"the view is too wide to show: {side_m:.3g} m")
    size_px = min(max(math.ceil(side_m / gsd_m), MIN_PX), MAX_PX)
    return GroundWindow(side_m, size_px, axis)


def rectified(
    grey: Grey, telemetry: Telemetry, camera: Camera, window: GroundWindow
) -> tuple[Grey, Mask]:
    """Grey and valid (size_px, size_px) of a view rectified to nadir in its window."""
    height, width = grey.shape
    if abs(height * camera.width_px - width * camera.height_px) > max(height, width) * 4:
        raise FlightError("the image does not have the proportions of the calibration")
    gsd_m = window.side_m / window.size_px
    view = downsampled(View(grey, camera.resized(width, height), telemetry), gsd_m)
    made = rectify(view, gsd_m=gsd_m, size_px=window.size_px)
    return made.grey, made.valid


def png(grey: Grey, valid: Mask) -> bytes:
    picture = grey if valid.all() else _transparent(grey, valid)
    return bytes(cv2.imencode(".png", picture, _QUICK)[1].tobytes())


def webp(grey: Grey, valid: Mask) -> bytes:
    return bytes(cv2.imencode(".webp", _transparent(grey, valid), _SMALL)[1].tobytes())


def _transparent(grey: Grey, valid: Mask) -> Grey:
    return np.dstack([grey, grey, grey, valid.astype(np.uint8) * 255])


def jpeg(grey: Grey) -> bytes:
    return bytes(cv2.imencode(".jpg", grey)[1].tobytes())


def shrunk(grey: Grey, max_px: int) -> Grey:
    size = shrunk_px((grey.shape[1], grey.shape[0]), max_px)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def shrunk_px(size_px: tuple[int, int], max_px: int) -> tuple[int, int]:
    """Width and height, of which the larger is at most `max_px`."""
    share = min(1.0, max_px / max(size_px))
    return max(1, round(share * size_px[0])), max(1, round(share * size_px[1]))


class SheetImagery:
    """The first sheet of a map: its grey layer, or its preview where it has none, and its heights.

    `terrain`: level where the map has none; `surface`: of houses and trees above it, if known."""

    def __init__(self, opened: MapFile) -> None:
        self.sheet = opened.manifest.sheets[0]
        self.frame, self.grid = self.sheet.frame, self.sheet.grid
        self._layer = GreyLayer.of(opened)
        self.terrain = TerrainLayer.of(opened) or FlatTerrain()
        self.surface = TerrainLayer.of(opened, layer=SURFACE)
        self.preview = b""
        drawn = "preview_jpeg" if self._layer is None else "grey/bytes"
        self._drawn_id = str(opened.manifest.parts[f"sheet0/{drawn}"].get("sha256"))[:12]
        self._small = np.zeros((0, 0), np.uint8)
        if self._layer is None:
            self._small = preview(opened)
            self.preview = opened.array("sheet0/preview_jpeg", np.uint8, 1).tobytes()

    def plain(self) -> dict[str, Any]:
        grid, grey = self.grid, self.sheet.grey
        tiles = None
        if self._layer is not None and grey is not None:
            shapes = [self._layer.shape(level) for level in range(self._layer.levels)]
            tiles = {"side_px": grey.chunk_px, "levels": [list(shape) for shape in shapes]}
        return {
            "origin_lat_deg": self.frame.lat_deg,
            "origin_lon_deg": self.frame.lon_deg,
            "west_m": grid.west_m,
            "north_m": grid.north_m,
            "gsd_m": grid.gsd_m,
            "width_px": grid.width_px,
            "height_px": grid.height_px,
            "tiles": tiles,
            "id": self._drawn_id,
        }

    def px_from_en(self, en_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Columns and rows (..., 2) of positions (..., 2) in the plane of the sheet."""
        grid = self.grid
        east, north = en_m[..., 0], en_m[..., 1]
        return np.stack([east - grid.west_m, grid.north_m - north], axis=-1) / grid.gsd_m

    def tile(self, level: int, col: int, row: int) -> tuple[bytes, str] | None:
        """A chunk of the layer and its media type; None where it has no imagery.

        Raises `IndexError` where there is no such tile and `MapFileError` where it is damaged.
        """
        if self._layer is None or self.sheet.grey is None:
            raise IndexError("the map has no layer")
        stored = self._layer.jpeg(level, row, col)
        if stored is not None:
            return stored, "image/jpeg"
        side = self.sheet.grey.chunk_px
        rows, cols = self._layer.shape(level)
        size = min(side, rows - row * side), min(side, cols - col * side)
        grey, valid = self._layer.read(level, row * side, col * side, *size)
        return (png(grey, valid), "image/png") if valid.any() else None

    def crop(self, box: Box, size_px: tuple[int, int]) -> tuple[Grey, Mask]:
        """Grey and valid (rows, cols) of a box, north up; `size_px`: columns and rows."""
        west, north = box[0] - self.grid.west_m, self.grid.north_m - box[3]  # from the corner
        step_x_m, step_y_m = (box[2] - box[0]) / size_px[0], (box[3] - box[1]) / size_px[1]
        if self._layer is None:
            grey, valid, first_row, first_col = self._small, np.ones(self._small.shape, bool), 0, 0
            row_m = self.grid.height_px * self.grid.gsd_m / grey.shape[0]
            col_m = self.grid.width_px * self.grid.gsd_m / grey.shape[1]
        else:
            fine = math.floor(math.log2(max(min(step_x_m, step_y_m) / self.grid.gsd_m, 1.0)) + 1e-6)
            level = min(fine, self._layer.levels - 1)
            row_m = col_m = self.grid.gsd_m * 2**level
            first_row, first_col = math.floor(north / row_m) - 1, math.floor(west / col_m) - 1
            rows = math.ceil((box[3] - box[1]) / row_m) + 4
            cols = math.ceil((box[2] - box[0]) / col_m) + 4
            if max(cols, rows) > MAX_READ_PX:
                nothing = np.zeros(size_px[::-1], np.uint8)
                return nothing, nothing > 0
            grey, valid = self._layer.read(level, first_row, first_col, rows, cols)
        scale_x, scale_y = step_x_m / col_m, step_y_m / row_m
        # OpenCV counts from the centres of pixels, we from the corner of the first one.
        from_window = np.array(
            [
                [scale_x, 0, west / col_m - first_col + scale_x / 2 - 0.5],
                [0, scale_y, north / row_m - first_row + scale_y / 2 - 0.5],
            ]
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        drawn = cv2.warpAffine(grey, from_window, size_px, flags=flags)
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        seen = cv2.warpAffine(valid.astype(np.uint8), from_window, size_px, flags=flags)
        return np.asarray(drawn, dtype=np.uint8), np.asarray(seen > 0, dtype=np.bool_)
