"""Scores of tiles by exact search, and a position from them by the rules of the literature.

*best*: "the position of the reference embedding leading to the highest scalar product" (Di Piazza
et al. 2024, section Methodology, Considered methods). *weighted*: mean of all centres, weighted by
scores above zero (Bianchi and Barfoot, RA-L 2021). *neighbours*: the best tile and those around it,
weighted by scores above the lowest (after Couturier and Akhloufi, 2021). *peak*: a parabola through
the best tile and its neighbours: a third of the error."""

from collections.abc import Iterator
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError
from orthonav.core.geo.grid import TileGrid

PositionRule = Literal["peak", "best", "neighbours", "weighted"]
RULES: tuple[PositionRule, ...] = get_args(PositionRule)


class TileNeighbours:
    """Tiles (N, 2) beside a tile, sorted by grid rows, then columns."""

    def __init__(self, grid: TileGrid, centres_en_m: NDArray[np.float32]) -> None:
        """Raises `MapFileError` where centres are not on the grid or not sorted."""
        tiles = grid.tiles_rc(centres_en_m)
        inside = (tiles >= 0).all() and (tiles < [grid.rows, grid.cols]).all()
        self._cols, self._shape = grid.cols, (grid.rows, grid.cols)
        self._centres_en_m, self._stride_m = centres_en_m, grid.stride_m
        self._flat = tiles[:, 0] * grid.cols + tiles[:, 1]
        if not inside or (np.diff(self._flat) <= 0).any():
            raise MapFileError("tile centres are not those of the tile grid, sorted by rows")

    def beside(self, tile: int, east: int, north: int) -> int | None:
        """Row of the tile, None if there is none."""
        row, col = divmod(int(self._flat[tile]), self._cols)
        if not 0 <= col + east < self._cols:
            return None
        return find(self._flat, (row - north) * self._cols + col + east)

    def maxima(
        self, scores: NDArray[np.float32], count: int, rows: NDArray[np.intp] | None = None
    ) -> NDArray[np.intp]:
        """Places in `scores` of the `count` best that no tile next to them exceeds, best first.

        `scores` (N,) belong to all tiles, or to sorted `rows`; those not finite are left out."""
        flat = self._flat if rows is None else self._flat[rows]
        on_grid = np.full(self._shape, -np.inf, np.float32)
        on_grid.flat[flat] = np.where(np.isfinite(scores), scores, -np.inf)
        highest = np.asarray(cv2.dilate(on_grid, np.ones((3, 3), np.uint8)))
        is_peak = np.isfinite(on_grid.flat[flat]) & (on_grid.flat[flat] >= highest.flat[flat])
        peaks = np.flatnonzero(is_peak)
        return np.asarray(peaks[np.argsort(-scores[peaks], kind="stable")[:count]])

    def peak_offset(
        self, scores: NDArray[np.float32], best: int, rows: NDArray[np.intp] | None = None
    ) -> tuple[float, float]:
        """(east, north) in strides within 0.5; zero on an axis where a neighbour is missing."""
        offsets = []
        for east, north in ((1, 0), (0, 1)):
            ahead, behind = (
                _score(scores, rows, self.beside(best, sign * east, sign * north))
                for sign in (1, -1)
            )
            offsets.append(parabola_peak(behind, _score(scores, rows, best), ahead))
        return offsets[0], offsets[1]

    def offset_en_m(
        self,
        rule: PositionRule,
        scores: NDArray[np.float32],
        best: int,
        rows: NDArray[np.intp] | None = None,
    ) -> tuple[float, float]:
        """(east, north) from the centre of the best tile, by a rule of position."""
        if rule == "best":
            return 0.0, 0.0
        if rule == "peak":
            east, north = self.peak_offset(scores, best, rows)
            return east * self._stride_m, north * self._stride_m
        if rule == "weighted":
            tiles = np.arange(len(self._centres_en_m)) if rows is None else rows
            weights = np.maximum(scores.astype(np.float64), 0)
        else:
            tiles, near = self.around(scores, best, rows)
            weights = near - near.min(initial=np.inf) if len(near) > 1 else np.ones(len(near))
        if not weights.sum() > 0:
            return 0.0, 0.0
        away = self._centres_en_m[tiles].astype(np.float64) - self._centres_en_m[best]
        east, north = weights @ away / weights.sum()
        return float(east), float(north)

    def around(
        self, scores: NDArray[np.float32], best: int, rows: NDArray[np.intp] | None = None
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """With those next to it, corners too, that have a score."""
        beside = [self.beside(best, east, north) for east in (-1, 0, 1) for north in (-1, 0, 1)]
        known = [(tile, _score(scores, rows, tile)) for tile in beside if tile is not None]
        tiles, values = zip(*(each for each in known if np.isfinite(each[1])), strict=True)
        return np.array(tiles, dtype=np.intp), np.array(values, dtype=np.float64)


def parabola_peak(behind: float, middle: float, ahead: float) -> float:
    """Of values at -1, 0, 1, within 0.5; zero where the middle is not the highest or one is NaN."""
    if not (middle >= behind and middle >= ahead):
        return 0.0
    curvature = 2 * middle - behind - ahead
    return (ahead - behind) / (2 * curvature) if curvature > 0 else 0.0


def find(sorted_values: NDArray[np.intp], value: int) -> int | None:
    at = int(np.searchsorted(sorted_values, value))
    return at if at < len(sorted_values) and sorted_values[at] == value else None


def _score(scores: NDArray[np.float32], rows: NDArray[np.intp] | None, tile: int | None) -> float:
    at = tile if tile is None or rows is None else find(rows, tile)
    return float("nan") if at is None else float(scores[at])


BLOCK_ROWS, BLOCK_NUMBERS = 1024, 2**19
"""At most decoded at once: two megabytes stay in the cache, twice as fast with 10,000 words."""
CACHE_BYTES = 128 * 2**20  # decoded embeddings kept: 260,000 tiles of 128 numbers
_CONVERT_FP16 = getattr(cv2, "convertFp16", None)  # OpenCV 4, where cv2.add knows no float16
_ZERO = np.zeros(1, dtype=np.float16)


class ExactIndex:
    """Scalar products with stored embeddings (N, D) float16.

    Up to `cache_bytes` are kept decoded to float32; larger maps are decoded at every search."""

    def __init__(self, embeddings: NDArray[np.float16], cache_bytes: int = CACHE_BYTES) -> None:
        if embeddings.ndim != 2 or embeddings.dtype != np.float16:
            raise ValueError(
                f"embeddings must be (N, D) float16, got {embeddings.shape} {embeddings.dtype}"
            )
        self._stored = embeddings
        self._may_cache = embeddings.size * 4 <= cache_bytes
        self._decoded: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self._stored)

    def scores(
        self, queries: NDArray[np.float32], rows: NDArray[np.intp] | None = None
    ) -> NDArray[np.float32]:
        """(N, Q) of queries (Q, D), with `rows` or all."""
        columns = np.ascontiguousarray(queries.T, dtype=np.float32)
        out = np.empty((self._count(rows), columns.shape[1]), dtype=np.float32)
        for part, block in self._blocks(rows):
            np.matmul(block, columns, out=out[part])
        return out

    def best(
        self, queries: NDArray[np.float32], rows: NDArray[np.intp] | None = None
    ) -> NDArray[np.float32]:
        """Highest (N,) of any query (Q, D), without memory of N times Q. Raises `ValueError`."""
        if len(queries) == 0:
            raise ValueError("at least one query is needed, got none")
        columns = np.ascontiguousarray(queries.T, dtype=np.float32)
        count = self._count(rows)
        out = np.empty(count, dtype=np.float32)
        scores = np.empty((min(count, self._block_rows), columns.shape[1]), dtype=np.float32)
        for part, block in self._blocks(rows):
            some = np.matmul(block, columns, out=scores[: len(block)])
            some.max(axis=1, out=out[part])
        return out

    @property
    def _block_rows(self) -> int:
        return max(1, min(BLOCK_ROWS, BLOCK_NUMBERS // max(1, int(self._stored.shape[1]))))

    def _count(self, rows: NDArray[np.intp] | None) -> int:
        return len(self._stored) if rows is None else len(rows)

    def _blocks(self, rows: NDArray[np.intp] | None) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        if self._may_cache and self._decoded is None:
            self._decoded = self._stored.astype(np.float32)
        source = self._stored if self._decoded is None else self._decoded
        # In blocks also where nothing is decoded: BLAS then takes a few queries twice as fast.
        for start in range(0, self._count(rows), self._block_rows):
            part = slice(start, start + self._block_rows)
            yield part, _float32(source[part] if rows is None else source[rows[part]])


def _float32(block: NDArray[np.float16] | NDArray[np.float32]) -> NDArray[np.float32]:
    """OpenCV's conversions are several times as fast as NumPy's."""
    if block.dtype == np.float32:
        return np.asarray(block, dtype=np.float32)
    halves = np.ascontiguousarray(block, dtype=np.float16)
    if _CONVERT_FP16 is not None:
        return np.asarray(_CONVERT_FP16(halves.view(np.int16))).reshape(halves.shape)
    decoded = cv2.add(halves, _ZERO, dtype=cv2.CV_32F)
    return np.asarray(decoded, dtype=np.float32).reshape(halves.shape)


def rows_within(
    centres_en_m: NDArray[np.float32], centre_en_m: NDArray[np.float64], radius_m: float
) -> NDArray[np.intp]:
    offset = centres_en_m - np.asarray(centre_en_m, dtype=np.float32)
    return np.flatnonzero(np.einsum("ij,ij->i", offset, offset) <= radius_m**2)
