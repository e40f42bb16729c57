"""Search alone, on real embeddings of more and more tiles of the same area."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.inputs import LANDSCAPE_SEED, PAST, Workplace
from benchmarks.machine import reading_gb_per_s, seconds
from benchmarks.record import Section, Table, number
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.tiles.cells import CellLayout
from orthonav.core.tiles.exact import CACHE_BYTES, ExactIndex
from orthonav.core.tiles.whitened import CellSheet, WhitenedEmbedder
from orthonav.ground.imagery.mosaic import Mosaic

SIZES = (1_000, 10_000, 100_000, 1_000_000)
DENSE_STRIDE_PX = 4
MIN_S = 1.0
MIN_RUNS, MAX_RUNS = 10, 300


def measure(place: Workplace) -> Section:
    """Time `ExactIndex.scores`, decoded once and decoded on the fly."""
    section = Section("Search")
    side_m, sizes = (2000, SIZES[:3]) if place.quick else (4000, SIZES)
    ortho = place.area(side_m, 1.0, [PAST])[0]
    stored = _dense_embeddings(ortho, place.map(ortho), sizes[-1])
    rng = np.random.default_rng(LANDSCAPE_SEED)
    queries = stored[rng.integers(0, len(stored), 3)].astype(np.float32)
    queries += rng.normal(0, 0.05, queries.shape).astype(np.float32)
    data = f"generated {side_m} m square, tiles every {DENSE_STRIDE_PX} px"
    rows = []
    for size in sizes:
        part = np.ascontiguousarray(stored[rng.permutation(len(stored))[:size]])
        for kind, cache_bytes, width in (("decoded", 2**40, 4), ("streamed", 0, 2)):
            index = ExactIndex(part, cache_bytes)
            touched = part.size * width
            floor_ms = touched / reading_gb_per_s(touched) / 1e6
            cells = []
            for count in (1, 3):
                name = f"{size} tiles, {kind}, {count} queries"
                times_ms = np.array(_times_s(index, queries[:count])) * 1e3
                timing = section.add(name, "ms", times_ms, data=data, seed=LANDSCAPE_SEED)
                cells += [number(timing.median), f"{number(timing.p10)}..{number(timing.p90)}"]
                cells.append(number(float(np.percentile(times_ms, 99))))
            held = part.nbytes + (part.size * 4 if kind == "decoded" else 0)
            rows.append([f"{size:,}", kind, *cells, number(floor_ms), number(held / 1e6)])
            if size == 100_000 and kind == "decoded":
                section.facts["search_100k_ms"] = section.measurements[-1].median
    header = ["tiles", "stored as", "1 query ms", "p10..p90", "p99"]
    header += ["3 queries ms", "p10..p90", "p99", "floor ms", "MB"]
    notes = (
        f"one core; {stored.shape[1]} numbers per tile; real embeddings of the generated "
        f"{side_m / 1000:g} x {side_m / 1000:g} km area, one tile every {DENSE_STRIDE_PX} px, "
        "taken at random",
        "decoded: float32 made once from the float16 of the map (default up to "
        f"{CACHE_BYTES / 1e6:.0f} MB); streamed: float16 decoded block by block at every search",
        "floor: reading the same bytes once at the rate this core reads arrays of that size "
        "(small ones come from caches); MB: float16 mapped from the file, and float32 if decoded",
    )
    section.tables = [Table("Search", header, rows, notes)]
    return section


def _times_s(index: ExactIndex, queries: NDArray[np.float32]) -> list[float]:
    first = max(seconds(index.scores, queries) for _ in range(2))
    runs = int(min(MAX_RUNS, max(MIN_RUNS, MIN_S / first)))
    return [seconds(index.scores, queries) for _ in range(runs)]


def _dense_embeddings(ortho: Path, map_path: Path, count: int) -> NDArray[np.float16]:
    """Embeddings (count, D) of tiles every few pixels, by the map's own embedder."""
    localizer = Localizer(open_map(map_path))
    sheet = localizer.sheet
    tile_px = sheet.grid.tile_px
    mosaic = Mosaic.open([ortho])
    outline = mosaic.outline_latlon_deg
    points = sheet.frame.en_from_latlon(outline[:, 0], outline[:, 1])
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    grid = TileGrid.covering(
        (float(west), float(south), float(east), float(north)),
        gsd_m=sheet.grid.gsd_m,
        tile_px=tile_px,
        overlap=1 - DENSE_STRIDE_PX / tile_px,
    )
    with mosaic.grid_sheet(sheet.frame, grid) as raster:
        pixels = raster.read(0, 0, grid.width_px, grid.height_px)
    layout = CellLayout.for_tiles(tile_px, grid.stride_px)
    representation = localizer.tiles.representation
    cells = CellSheet(layout, grid.height_px, grid.width_px, representation.channels)
    cells.fill(0, 0, representation(pixels.grey, pixels.valid), pixels.valid)
    tiles = np.indices((grid.rows, grid.cols)).reshape(2, -1).T.astype(np.intp)
    rng = np.random.default_rng(LANDSCAPE_SEED)
    taken = np.sort(rng.permutation(len(tiles))[:count])
    if len(taken) < count:
        raise RuntimeError(f"area holds {len(taken)} tiles, {count} are needed: {ortho}")
    assert isinstance(localizer.tiles.embedder, WhitenedEmbedder)
    return localizer.tiles.embedder.tiles(cells, tiles[taken] * grid.stride_px)
