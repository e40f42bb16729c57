"""Layers of a map: the grey pyramid of registration, terrain, surface.

A chunk is encoded as soon as it is complete, and passed at half the resolution to the next level,
so memory holds compressed chunks and incomplete ones; heights are held as float32, 4 MB per km2 of
a surface.
"""

import logging
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, ImageryError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.ground import bilinear_of
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.mapfile.layer import ChunkTable, part_names
from orthonav.core.mapfile.manifest import (
    MAX_CODE,
    MAX_LEVELS,
    MAX_NAME,
    GreyInfo,
    Lean,
    TerrainInfo,
    clamped,
)
from orthonav.core.mapfile.reader import blob_parts
from orthonav.core.mapfile.terrain import SURFACE, TERRAIN, encode_terrain, terrain_part_names
from orthonav.ground.build.lean import TRUE_ORTHO, PlaneSampler, as_shown, visible_lean
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import Dem
from orthonav.ground.planning.area import Area

CHUNK_PX = 256
"""A view touches few chunks, and each decodes in 0.1 to 0.2 ms (docs/map-format.md)."""
QUALITY = 70
"""Registration peaks are within 1 % of those of uncompressed imagery (docs/map-format.md)."""
MAX_BYTES_PER_PX = 0.5
"""Of a chunk: those of noise have a lower quality, so that the size of a map is bounded."""
Parts = dict[str, NDArray[Any]]


def level_count(height_px: int, width_px: int) -> int:
    """Levels are added until the larger side is at most 64 px."""
    halvings = max(0, math.ceil(math.log2(max(height_px, width_px) / 64)))
    return min(1 + halvings, MAX_LEVELS)


def halved(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Grey and valid (H, W) at half the resolution, (ceil(H / 2), ceil(W / 2)).

    Means of the valid ones of four pixels, rounded half up; valid if two or more of them are.
    """
    rows, cols = grey.shape
    if rows % 2 == cols % 2 == 0 and valid.all():
        # OpenCV rounds half up too, and is twenty times as fast.
        small = cv2.resize(grey, (cols // 2, rows // 2), interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.uint8), np.ones((rows // 2, cols // 2), np.bool_)
    border = ((0, rows % 2), (0, cols % 2))
    weight = np.pad(valid, border).astype(np.uint16)
    count = _sum_of_four(weight)
    total = _sum_of_four(np.pad(grey, border) * weight)
    enough = count >= 2
    mean = (total + count // 2) // np.maximum(count, 1)
    return np.where(enough, mean, 0).astype(np.uint8), enough


def _sum_of_four(values: NDArray[np.uint16]) -> NDArray[np.uint16]:
    pairs = values[0::2] + values[1::2]
    return pairs[:, 0::2] + pairs[:, 1::2]


class _Pending:
    def __init__(self, shape: tuple[int, int]) -> None:
        self.grey = np.zeros(shape, dtype=np.uint8)
        self.valid = np.zeros(shape, dtype=bool)
        self.missing_px = shape[0] * shape[1]


class GreyLayerWriter:
    """Takes blocks of any size in any order."""

    def __init__(self, height_px: int, width_px: int, chunk_px: int = CHUNK_PX) -> None:
        self._chunk_px = chunk_px
        self._levels = level_count(height_px, width_px)
        self._table = ChunkTable(height_px, width_px, self._levels, chunk_px)
        self._pending: list[dict[tuple[int, int], _Pending]] = [{} for _ in range(self._levels)]
        self._encoded: dict[int, tuple[bytes, bytes]] = {}
        self._valid_px = 0

    def add(self, row: int, col: int, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> None:
        """Add a block (H, W); no pixel may be added twice, and those never added are invalid."""
        self._valid_px += int(np.count_nonzero(valid))
        self._add(0, row, col, grey, valid)

    def finish(self) -> tuple[GreyInfo, Parts]:
        for level, pending in enumerate(self._pending):
            for place in sorted(pending):
                self._complete(level, place)
        chunks = [self._encoded.get(number, (b"", b"")) for number in range(self._table.count)]
        names = part_names(0)
        parts: Parts = {}
        for index, kind in enumerate(("", "mask_")):
            data, offsets = names[f"{kind}bytes"], names[f"{kind}offsets"]
            parts |= blob_parts(data, offsets, [chunk[index] for chunk in chunks])
        return GreyInfo(self._chunk_px, self._levels, QUALITY, self._valid_px), parts

    def _add(
        self, level: int, row: int, col: int, grey: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> None:
        for place, inside, part in self._table.parts(level, row, col, *grey.shape):
            chunk = self._pending[level].get(place)
            if chunk is None:
                chunk = self._pending[level][place] = _Pending(self._table.shape(level, *place))
            chunk.grey[inside], chunk.valid[inside] = grey[part], valid[part]
            chunk.missing_px -= grey[part].size
            if chunk.missing_px == 0:
                self._complete(level, place)

    def _complete(self, level: int, place: tuple[int, int]) -> None:
        chunk = self._pending[level].pop(place)
        if chunk.valid.any():
            number = self._table.number(level, *place)
            self._encoded[number] = encode_chunk(chunk.grey, chunk.valid)
        if level + 1 < self._levels:
            half = self._chunk_px // 2
            smaller = halved(chunk.grey, chunk.valid)
            self._add(level + 1, place[0] * half, place[1] * half, *smaller)


def encode_chunk(grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> tuple[bytes, bytes]:
    """JPEG of a chunk (H, W), and its mask, empty if all of it is valid."""
    if valid.all():
        return _jpeg(grey), b""
    # Filling with the mean gives the smallest file and the weakest edge.
    filled = np.where(valid, grey, round(float(grey[valid].mean()))).astype(np.uint8)
    return _jpeg(filled), zlib.compress(np.packbits(valid).tobytes(), 9)


def _jpeg(grey: NDArray[np.uint8]) -> bytes:
    encoded = b""
    for quality in (QUALITY, 50, 30):
        options = [int(cv2.IMWRITE_JPEG_QUALITY), quality, int(cv2.IMWRITE_JPEG_OPTIMIZE), 1]
        encoded = cv2.imencode(".jpg", grey, options)[1].tobytes()
        if len(encoded) <= MAX_BYTES_PER_PX * grey.size + 512:
            break
    return encoded


POSTING_M = 10.0
"""Distance of samples; that of the terrain model where it is coarser."""
TERRAIN_CHUNK_PX = 128
log = logging.getLogger(__name__)


def rounded_gsd_m(gsd_m: float) -> float:
    """To few digits: 5.002 to 5, 0.2431 to 0.243."""
    for digits in (1, 2, 3):
        rounded = float(f"{gsd_m:.{digits}g}")
        if abs(rounded / gsd_m - 1) < 0.005:
            return rounded
    return float(f"{gsd_m:.4g}")


class TerrainParts(NamedTuple):
    info: TerrainInfo
    arrays: dict[str, NDArray[Any]]


def terrain_of_dem(
    dem: Dem, area: Area, grid: TileGrid, *, needed: bool = True
) -> TerrainParts | None:
    """None where the model has no height in the area; `AreaError` if it is `needed`."""
    posting_m = clamped(TerrainInfo, "posting_m", max(POSTING_M, rounded_gsd_m(dem.gsd_m)))
    heights = partial(dem.in_plane, area.frame)
    made = terrain_parts(area, grid, posting_m, dem.path.name, dem.datum.name, heights)
    if made is None and needed:
        raise _no_height("terrain", area, dem)
    if made is None:
        return None
    source_m = clamped(TerrainInfo, "source_posting_m", rounded_gsd_m(dem.gsd_m))
    roughness_m = _roughness_m(made.info, dem, area)
    info = replace(made.info, source_posting_m=source_m, roughness_m=roughness_m)
    return made._replace(info=info)


def _no_height(what: str, area: Area, dem: Dem) -> AreaError:
    centre = area.frame.lat_deg, area.frame.lon_deg
    hint = swapped_hint(*centre, dem.covers)
    return AreaError(
        f"the {what} has no height in the area, at {centre[0]:.4f}, {centre[1]:.4f}{hint}: "
        f"{dem.path}"
    )


@dataclass(frozen=True)
class SurfaceLimits:
    """What a surface model must be, and where it shows bare ground; metres."""

    max_gsd_m: float = 3.0  # wider samples do not show houses
    bare_percent: float = 5.0  # at least so much of a surface is bare ground
    offset_samples: int = 256  # across the area, that show it
    max_off_m: float = 10.0
    """Largest height of bare ground above or below a terrain model of a known datum,"""
    max_datum_m: float = 120.0
    """and of an unknown one: heights above ellipsoid and geoid differ by up to 107 m."""
    envelope_m: float = 2.0  # samples of the lower envelope that stands for bare earth,
    widest_m: float = 40.0  # without narrower houses and trees


SURFACE_LIMITS = SurfaceLimits()


class Surface:
    """Heights of surface models, earlier ones before later ones, in the plane of an area."""

    def __init__(self, models: Sequence[Dem], area: Area) -> None:
        """Raises `ImageryError` for models that show no houses."""
        for each in models:
            if each.gsd_m > SURFACE_LIMITS.max_gsd_m:
                raise ImageryError(
                    f"surface model has a height every {each.gsd_m:.3g} m, which shows no houses; "
                    f"give it as --dem ({SURFACE_LIMITS.max_gsd_m:g} m at most): {each.path}"
                )
        self.models, self.area = models, area
        self.gsd_m = min(each.gsd_m for each in models)
        self.name = ", ".join(each.path.name for each in models)[:MAX_NAME]
        self.datum = ", ".join(sorted({each.datum.name for each in models}))[:MAX_NAME]

    def sampled(
        self, west_m: float, north_m: float, posting_m: float, rows: int, cols: int
    ) -> NDArray[np.float64]:
        """Means of squares, NaN for holes; arguments as of `Dem.in_plane`."""
        found = np.full((rows, cols), np.nan)
        ends_m = np.array([[0, 0], [0, -rows], [cols, 0], [cols, -rows]]) * posting_m
        corners = self.area.frame.latlon_from_en(ends_m + np.array([west_m, north_m]))
        for each in self.models:
            if np.isnan(found).any() and each.meets(*corners):
                more = each.in_plane(self.area.frame, west_m, north_m, posting_m, rows, cols)
                found = np.where(np.isnan(found), more, found)
        return found

    def above_m(self, dem: Dem) -> float:
        """Height of bare ground above that of a terrain model, where the datum of either is not
        known. Raises `ImageryError` for more than can be, as with other units."""
        known = all(each.datum.is_known for each in (dem, *self.models))
        west, south, east, north = self.area.extent_en_m
        posting_m = max(east - west, north - south) / SURFACE_LIMITS.offset_samples
        rows, cols = (max(round(side / posting_m), 1) for side in (north - south, east - west))
        off_m = self.sampled(west, north, posting_m, rows, cols)
        off_m -= dem.in_plane(self.area.frame, west, north, posting_m, rows, cols)
        if not np.isfinite(off_m).any():
            return 0.0
        low_m = float(np.nanpercentile(off_m, SURFACE_LIMITS.bare_percent))
        if abs(low_m) > (SURFACE_LIMITS.max_off_m if known else SURFACE_LIMITS.max_datum_m):
            raise ImageryError(
                f"bare ground of the surface lies {low_m:.0f} m above the terrain: check unit and "
                f"vertical datum of {self.name} and {dem.path.name}"
            )
        if known:
            return 0.0
        log.info("the surface is taken to lie %.1f m above the terrain on bare ground", low_m)
        return low_m

    def envelope(
        self, west_m: float, north_m: float, posting_m: float, rows: int, cols: int
    ) -> NDArray[np.float64]:
        """The same of bare earth: the surface without what is narrower than `widest_m`, by a
        morphological opening."""
        fine = round(posting_m / max(SURFACE_LIMITS.envelope_m, self.gsd_m))
        fine_m = posting_m / fine
        side = 2 * math.ceil(SURFACE_LIMITS.widest_m / fine_m / 2) + 1
        shape = rows * fine + 2 * side, cols * fine + 2 * side
        corner = west_m - side * fine_m, north_m + side * fine_m
        heights = self.sampled(*corner, fine_m, *shape).astype(np.float32)
        window = np.ones((side, side), np.uint8)
        low = cv2.erode(np.nan_to_num(heights, nan=np.inf), window)
        low[np.isinf(low)] = np.nan
        high = cv2.dilate(np.nan_to_num(low, nan=-np.inf), window)
        high[np.isinf(high)] = np.nan
        inside = high[side:-side, side:-side].reshape(rows, fine, cols, fine)
        return np.asarray(inside.mean(axis=(1, 3)), np.float64)


class HeightLayers(NamedTuple):
    """`surface`: where the orthophoto shows it, by `lean`; None: not known."""

    terrain: TerrainParts | None
    surface: TerrainParts | None
    lean: Lean | None = None

    @property
    def infos(self) -> tuple[TerrainInfo | None, TerrainInfo | None]:
        terrain, surface = (None if each is None else each.info for each in self[:2])
        return terrain, surface

    @property
    def arrays(self) -> Parts:
        return {name: part for each in self[:2] if each for name, part in each.arrays.items()}


def height_layers(
    dem: Dem | None,
    models: Sequence[Dem],
    area: Area,
    grid: TileGrid,
    imagery: Mosaic | None = None,
    *,
    needed: bool = True,
) -> HeightLayers:
    """Of a terrain model and of surface models. Without a terrain model the lower envelope of the
    surface stands for it. `imagery`: None: a true orthophoto, in which houses stand upright.

    `needed`: `AreaError` where the area has no height; else a layer without one is left out.
    Raises `ImageryError` for a surface that shows no houses, or is of another datum."""
    terrain = None if dem is None else terrain_of_dem(dem, area, grid, needed=needed)
    if not models:
        return HeightLayers(terrain, None)
    surface = Surface(models, area)
    if dem is None:
        ground: PlaneSampler = surface.envelope
        terrain = terrain_parts(area, grid, POSTING_M, surface.name, surface.datum, ground)
    else:
        ground = partial(_raised, dem, area, surface.above_m(dem))
    made = lean = None
    if terrain is not None:
        above = partial(_above, surface, ground, terrain.info)
        lean = TRUE_ORTHO if imagery is None else visible_lean(imagery, above, area)
        # Every metre, half the 2 m at which views are rectified.
        posting_m = max(1.0, rounded_gsd_m(surface.gsd_m))
        shown = as_shown(above, lean or TRUE_ORTHO)
        place = area, grid, posting_m, surface.name, "terrain"
        made = terrain_parts(*place, shown, layer=SURFACE, unit_m=0.25)
    if made is None and needed:
        raise _no_height("surface", area, models[0])
    return HeightLayers(terrain, made, lean)


def _raised(dem: Dem, area: Area, by_m: float, *window: Any) -> NDArray[np.float64]:
    return dem.in_plane(area.frame, *window) + by_m


def _above(
    surface: Surface,
    ground: PlaneSampler,
    info: TerrainInfo,
    west_m: float,
    north_m: float,
    posting_m: float,
    rows: int,
    cols: int,
) -> NDArray[np.float64]:
    """Houses and trees above a terrain `info` with heights `ground`; a `PlaneSampler`."""
    heights = surface.sampled(west_m, north_m, posting_m, rows, cols)
    row, col = np.mgrid[:rows, :cols] + 0.5
    col = (west_m + col * posting_m - info.west_m) / info.posting_m - 0.5
    row = (info.north_m - north_m + row * posting_m) / info.posting_m - 0.5
    left, top = (math.floor(float(each.min())) for each in (col, row))
    size = math.ceil(float(row.max())) - top + 2, math.ceil(float(col.max())) - left + 2
    corner = info.west_m + left * info.posting_m, info.north_m - top * info.posting_m
    below = ground(*corner, info.posting_m, *size)
    return heights - bilinear_of(below, col - left, row - top)


def _roughness_m(info: TerrainInfo, dem: Dem, area: Area) -> float | None:
    """RMS difference of the heights of the source from those of the layer; None where the source is
    not finer. In 4 squares of 16 postings along each side, each of at most 8 samples."""
    finer = min(round(info.posting_m / dem.gsd_m), 8)
    side = min(16, info.rows, info.cols)
    if finer < 2 or side < 3:
        return None
    squares = []
    for first_row, first_col in product(_firsts(info.rows, side), _firsts(info.cols, side)):
        west = info.west_m + first_col * info.posting_m
        north = info.north_m - first_row * info.posting_m
        half_m = side * info.posting_m / 2
        if not area.contains(np.array([[west + half_m, north - half_m]]), half_m)[0]:
            continue
        shape = side * finer, side * finer
        fine = dem.in_plane(area.frame, west, north, info.posting_m / finer, *shape)
        off_m = _off_means_m(fine, finer)
        squares.append(off_m[np.isfinite(off_m)] ** 2)
    found = np.concatenate(squares) if squares else np.empty(0)
    if not found.size:
        return None
    return round(clamped(TerrainInfo, "roughness_m", float(np.sqrt(found.mean()))), 3)


def _off_means_m(fine: NDArray[np.float64], finer: int) -> NDArray[np.float64]:
    """Differences of the heights (N, N) of a square from those between means over `finer` samples a
    side, without the rim, where these lie on one side only."""
    side = len(fine) // finer
    means = fine.reshape(side, finer, side, finer).mean(axis=(1, 3))
    at = (np.arange(len(fine)) + 0.5) / finer - 0.5
    col, row = np.meshgrid(at, at)
    return np.asarray((fine - bilinear_of(means, col, row))[finer:-finer, finer:-finer])


def _firsts(count: int, side: int) -> list[int]:
    """Where squares of `side` samples begin, one in the middle of each equal part."""
    number = min(4, count // side)
    return [round((k + 0.5) * count / number - side / 2) for k in range(number)]


def terrain_parts(
    area: Area,
    grid: TileGrid,
    posting_m: float,
    name: str,
    datum: str,
    sampled: PlaneSampler,
    *,
    layer: str = TERRAIN,
    unit_m: float = 0.1,
) -> TerrainParts | None:
    """None where the source has no height; smaller holes stay holes, and a warning names them."""
    west_m, north_m = grid.west_m - posting_m, grid.north_m + posting_m
    rows = math.ceil(grid.height_px * grid.gsd_m / posting_m) + 2
    cols = math.ceil(grid.width_px * grid.gsd_m / posting_m) + 2
    table = ChunkTable(rows, cols, 1, TERRAIN_CHUNK_PX)
    found: dict[int, NDArray[np.float32]] = {}
    inside = unknown = 0
    for chunk_row, chunk_col in np.ndindex(
        -(-rows // TERRAIN_CHUNK_PX), -(-cols // TERRAIN_CHUNK_PX)
    ):
        shape = table.shape(0, chunk_row, chunk_col)
        west = west_m + chunk_col * TERRAIN_CHUNK_PX * posting_m
        north = north_m - chunk_row * TERRAIN_CHUNK_PX * posting_m
        middle = [west + shape[1] * posting_m / 2, north - shape[0] * posting_m / 2]
        reach_m = math.hypot(*shape) / 2 * posting_m + grid.tile_m + grid.stride_m
        if area.route is not None and not area.contains(np.array([middle]), reach_m)[0]:
            continue  # too far from the route for any view
        heights = sampled(west, north, posting_m, *shape).astype(np.float32)
        row, col = np.mgrid[: shape[0], : shape[1]] + 0.5
        points = np.stack([west + col * posting_m, north - row * posting_m], axis=-1)
        here = area.contains(points.reshape(-1, 2)).reshape(shape)
        inside += int(here.sum())
        unknown += int((here & np.isnan(heights)).sum())
        if np.isfinite(heights).any():
            found[table.number(0, chunk_row, chunk_col)] = heights
    if not found:
        return None
    if unknown:
        log.warning(
            "%s has no height for %.1f %% of the area: these holes stay holes in the map (%s)",
            layer,
            100 * unknown / inside,
            name,
        )
    low_m = math.floor(min(float(np.nanmin(each)) for each in found.values()) * 10) / 10
    high_m = max(float(np.nanmax(each)) for each in found.values())
    while high_m - low_m > unit_m * MAX_CODE:
        unit_m *= 2
    known = sum(int(np.isfinite(each).sum()) for each in found.values())
    high_m = round(high_m, 3)
    info = TerrainInfo(
        *(west_m, north_m, posting_m, rows, cols, TERRAIN_CHUNK_PX),
        *(low_m, high_m, unit_m, known, name, datum),
    )
    blobs = [
        encode_terrain(found[number], info) if number in found else b""
        for number in range(table.count)
    ]
    return TerrainParts(info, blob_parts(*terrain_part_names(0, layer), blobs))
