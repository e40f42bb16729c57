"""Means of micro-cells as parts of a map, from which new tiles are embedded without imagery.

The numbers of a cell are quantized to a byte each, relative to the largest, which is stored as a
float16: nine bytes for the seven of oriented gradients. The rounding error is at most 0.4 % of the
largest; each number of a tile sums over dozens of cells.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.tiles.cells import CellLayout
from orthonav.core.tiles.whitened import CellSheet

MIDDLE, LEVELS = 128, 127
WHOLE = 255
_ROWS_AT_ONCE = 256
_SMALLEST = float(np.finfo(np.float16).tiny)


def cell_parts(cells: CellSheet, sheet: int = 0) -> dict[str, NDArray[Any]]:
    """Map parts with the cell means of a sheet, and the valid shares unless all are 1."""
    codes = np.full(cells.means.shape, MIDDLE, dtype=np.uint8)
    scale = np.zeros(cells.valid.shape, dtype=np.float16)
    valid = np.zeros(cells.valid.shape, dtype=np.uint8)
    for first in range(0, len(codes), _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        means = cells.means[rows]
        scale[rows] = np.abs(means).max(axis=2) / LEVELS
        unit = np.maximum(scale[rows].astype(np.float32), _SMALLEST)[..., None]
        codes[rows] = np.clip(np.rint(means / unit) + MIDDLE, MIDDLE - LEVELS, WHOLE)
        valid[rows] = cells.valid[rows] * WHOLE + 1e-3  # truncated: only complete cells get 255
    names = _names(sheet)
    parts: dict[str, NDArray[Any]] = {names["codes"]: codes, names["scale"]: scale}
    return parts if (valid == WHOLE).all() else {**parts, names["valid"]: valid}


class StoredCells:
    """Cell means of a sheet in an opened map. May be shared between threads."""

    def __init__(self, opened: MapFile, layout: CellLayout, channels: int, sheet: int = 0) -> None:
        """Use `of`. Raises `MapFileError` if the parts do not fit the manifest."""
        grid = opened.manifest.sheets[sheet].grid
        names = _names(sheet)
        self.layout = layout
        self.shape = layout.samples(grid.height_px), layout.samples(grid.width_px)
        self._codes = opened.array(names["codes"], np.uint8, 3)
        self._scale = opened.array(names["scale"], np.float16, 2)
        whole = names["valid"] not in opened.arrays
        self._valid = None if whole else opened.array(names["valid"], np.uint8, 2)
        shapes = [part.shape for part in (self._scale, self._valid) if part is not None]
        if self._codes.shape != (*self.shape, channels) or set(shapes) != {self.shape}:
            raise MapFileError(
                f"map's cells must be {self.shape} of {channels} numbers, got "
                f"{self._codes.shape}: {opened.path}"
            )

    @classmethod
    def of(
        cls, opened: MapFile, layout: CellLayout, channels: int, sheet: int = 0
    ) -> "StoredCells | None":
        """The cells of a sheet; None if the map has none.

        Raises `MapFileError` if they do not fit its grid.
        """
        there = _names(sheet)["codes"] in opened.arrays
        return cls(opened, layout, channels, sheet) if there else None

    def read(
        self, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Means (height, width, C) and shares (height, width) of the window at (row, col).

        It may reach beyond the sheet or lie outside it, where both are 0.
        """
        channels = self._codes.shape[2]
        means = np.zeros((max(height, 0), max(width, 0), channels), dtype=np.float32)
        share = np.zeros(means.shape[:2], dtype=np.float32)
        top, left = max(row, 0), max(col, 0)
        bottom, right = min(row + height, self.shape[0]), min(col + width, self.shape[1])
        if top >= bottom or left >= right:
            return means, share
        part = np.s_[top:bottom, left:right]
        inside = np.s_[top - row : bottom - row, left - col : right - col]
        scale = self._scale[part].astype(np.float32)
        means[inside] = (self._codes[part].astype(np.float32) - MIDDLE) * scale[..., None]
        share[inside] = 1.0
        if self._valid is not None:
            share[inside] = self._valid[part] / np.float32(WHOLE)
        return means, share


def _names(sheet: int) -> dict[str, str]:
    return {kind: f"sheet{sheet}/cells/{kind}" for kind in ("codes", "scale", "valid")}
