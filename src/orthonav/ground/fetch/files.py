"""Cloud-optimized GeoTIFFs, read by windows through GDAL's /vsicurl, and the search of a STAC API.

Files keep their pixels on one grid; those off the grid of the first (another zone or phase) are
resampled into it. Documents of STAC 0.9 and 1.0 are read as plain JSON; pystac-client was tried
instead (docs/decisions/dependencies.md).
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import MaskFlags, Resampling
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform_bounds

from orthonav.core.errors import FetchError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.fetch.grid import CellGrid, Selection, mean_scale
from orthonav.ground.fetch.presets import (
    ImageryOptions,
    SourceSpec,
    choose,
    finest_fitting,
    is_fine_enough,
    listed,
)
from orthonav.ground.fetch.service import (
    GDAL_OPTIONS,
    CellPixels,
    CellReader,
    CellSource,
    reason_of,
)
from orthonav.ground.fetch.urls import TOKEN, Secret, checked_url, linked, origin_of, shown
from orthonav.ground.fetch.web import Web
from orthonav.ground.imagery.mosaic import WHOLLY_VALID
from orthonav.ground.imagery.source import quiet
from orthonav.ground.planning.area import Area

MAX_ITEMS = 500  # files of one fetch: an open dataset each, per thread
MAX_PAGES = 200
CELL_PX = 512  # GDAL's block size for COG, so a cell is usually one block
MAX_BLOCK_BYTES = 64 * 2**20
"""Largest block, unpacked: one of a tiled file has at most a few megabytes."""


@dataclass(frozen=True, eq=False)
class CogLevel:
    url: str  # may hold `{key}` or `{token}`
    level: int | None  # index of the overview; None is the full resolution
    transform: Affine
    bounds: tuple[float, float, float, float]
    crs: str
    dtype: str
    count: int


def cog_source(web: Web, spec: SourceSpec, area: Area, urls: list[str]) -> CellSource:
    """The files as one source, on the grid of the first at the level that fits the options.

    Where they overlap, the first valid pixel counts. Raises `FetchError` where one cannot be read
    or they differ in pixel type or bands.
    """
    options = spec.options
    files = [_inspect(web, url, options, area.frame) for url in urls]
    first = files[0]
    bands = options.bands or ((1,) if first.count < 3 else (1, 2, 3))
    for file in files:
        if file.dtype != first.dtype or max(bands) > file.count:
            raise FetchError(
                f"files are of different kinds ({first.count} bands of {first.dtype}, "
                f"{file.count} of {file.dtype}): {shown(file.url)}"
            )
    origin, res_x, res_y = first.transform, first.transform.a, -first.transform.e
    grid = CellGrid(first.crs, origin.c, origin.f, res_x, res_y, CELL_PX, CELL_PX)
    placed = [(file, transform_bounds(file.crs, grid.crs, *file.bounds)) for file in files]

    def reader(web: Web, _: Selection, __: Path) -> CellReader:
        def read(row: int, col: int) -> CellPixels:
            pixels = np.zeros((len(bands), CELL_PX, CELL_PX), dtype=first.dtype)
            valid = np.zeros((CELL_PX, CELL_PX), dtype=bool)
            west, south, east, north = grid.bounds(row, col)
            for file, (left, bottom, right, top) in placed:
                if left < east and right > west and bottom < north and top > south:
                    found, mask = _read(web, file, grid, (row, col), bands)
                    new = mask & ~valid
                    pixels[:, new] = found[:, new]
                    valid |= new
                if valid.all():
                    break
            return CellPixels(pixels, valid)

        return read

    # A usual JPEG block takes 0.35 of its pixels.
    cell_bytes = CELL_PX**2 * np.dtype(first.dtype).itemsize * len(bands) * 0.35
    return CellSource(spec.provenance, grid, len(bands), first.dtype, cell_bytes, reader)


@contextmanager
def _opened(web: Web, url: str, level: int | None = None) -> Iterator[Any]:
    checked_url(url.replace("{", "").replace("}", ""))
    settings = GDAL_OPTIONS | {
        "GDAL_HTTP_MAX_RETRY": web.limits.attempts - 1,
        "GDAL_HTTP_RETRY_DELAY": web.limits.backoff_s,
        "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
        "CPL_VSIL_CURL_USE_HEAD": False,
    }
    options = {} if level is None else {"overview_level": level}
    try:
        path = f"/vsicurl/{web.with_keys(url)}"
        with (
            quiet(),
            rasterio.Env(**settings),
            rasterio.open(path, driver="GTiff", **options) as file,
        ):
            yield file
    except (FetchError, MemoryError):
        raise
    except Exception as error:  # whatever GDAL raises may quote the address with its key
        reason = web.redacted(reason_of(error)[0])
        raise FetchError(f"not a GeoTIFF that can be read ({reason}): {shown(url)}") from None


def _inspect(web: Web, url: str, options: ImageryOptions, frame: LocalFrame) -> CogLevel:
    level = None
    with _opened(web, url) as whole:
        if whole.crs is None:
            raise FetchError(f"file has no coordinate system: {shown(url)}")
        if options.gsd_m is not None:
            native_m = abs(whole.transform.a) * mean_scale(whole.crs.to_string(), frame)
            gsds_m = [native_m * factor for factor in (1, *whole.overviews(1))]
            levels = ", ".join(f"{gsd_m:.3g} m" for gsd_m in gsds_m)
            chosen = finest_fitting(gsds_m, options.gsd_m, levels)
            level = chosen - 1 if chosen else None
    with _opened(web, url, level) as dataset:
        transform = dataset.transform
        if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
            raise FetchError(f"file is rotated or not georeferenced: {shown(url)}")
        dtype = str(dataset.dtypes[0])
        if dtype not in ("uint8", "uint16", "int16", "float32"):
            raise FetchError(f"file has unsupported pixels ({dtype}): {shown(url)}")
        # Neither packed nor unpacked may a block exhaust memory: an untiled file is one huge block.
        block_px = max(height * width for height, width in dataset.block_shapes)
        if block_px * dataset.count * np.dtype(dtype).itemsize > MAX_BLOCK_BYTES:
            raise FetchError(f"blocks are too large to be read by windows: {shown(url)}")
        crs, bounds = dataset.crs.to_string(), tuple(dataset.bounds)
        return CogLevel(url, level, transform, bounds, crs, dtype, dataset.count)


def _read(
    web: Web, file: CogLevel, grid: CellGrid, cell: tuple[int, int], bands: tuple[int, ...]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    with _opened(web, file.url, file.level) as dataset:
        has_alpha = MaskFlags.alpha in dataset.mask_flag_enums[0]
        adds_alpha = dataset.nodata is None and not has_alpha
        with WarpedVRT(
            dataset,
            crs=grid.crs,
            transform=grid.transform(*cell),
            width=grid.cell_w_px,
            height=grid.cell_h_px,
            resampling=Resampling.bilinear,
            add_alpha=adds_alpha,
        ) as placed:
            pixels = placed.read(list(bands))
            if adds_alpha or has_alpha:
                alpha = placed.read(placed.count)
                return pixels, alpha >= (WHOLLY_VALID if adds_alpha else 1)
            return pixels, (placed.read_masks(list(bands)) > 0).any(axis=0)


def stac_source(web: Web, spec: SourceSpec, area: Area, margin_m: float) -> CellSource:
    """The files that a STAC API finds in the area, a margin around it and the time requested,
    newest on top.

    Of items whose names differ by a year only the newest is taken. Raises `FetchError` where there
    are none.
    """
    options = spec.options
    items: list[tuple[str, str, str]] = []  # time, name, address
    for feature, where in _found(web, spec, area, margin_m):
        items.append(_item(feature, where, options))
        if len(items) > MAX_ITEMS:
            problem = f"more than {MAX_ITEMS} files; choose a smaller area or time"
            raise FetchError(f"{problem}: {spec.url}")
    if not items:
        when = f" at {options.time}" if options.time else ""
        raise FetchError(f"catalogue has no imagery of the area{when}: {spec.url}")
    newest: dict[str, tuple[str, str]] = {}
    for time, name, url in sorted(items, reverse=True):
        newest.setdefault(re.sub(r"(?<!\d)(19|20)\d\d(?!\d)", "", name), (time, url))
    days = sorted({time[:10] for time, _ in newest.values() if time})
    if days:
        date = "/".join(dict.fromkeys([days[0], days[-1]]))
        spec = replace(spec, provenance=replace(spec.provenance, date=date))
    urls = [url for _, url in newest.values()]
    return cog_source(web, spec, area, _signed(web, spec.token_url, urls))


def _signed(web: Web, token_url: str | None, urls: list[str]) -> list[str]:
    """Addresses with `{token}`, for which a service issued a query string.

    The token goes only to the origins of these addresses.
    """
    if token_url is None:
        return urls
    token = web.get_json(token_url).get("token")
    if not isinstance(token, str) or not token:
        raise FetchError(f"signing service returned no token: {token_url}")
    for origin in {origin_of(url) for url in urls}:
        web.secrets.append(Secret(TOKEN, origin, token.lstrip("?")))
    return [f"{url}{'&' if '?' in url else '?'}{TOKEN}" for url in urls]


def _found(
    web: Web, spec: SourceSpec, area: Area, margin_m: float
) -> Iterator[tuple[dict[str, Any], str]]:
    west, south, east, north = np.array(area.extent_en_m) + np.array([-1, -1, 1, 1]) * margin_m
    corners = [(west, south), (west, north), (east, south), (east, north)]
    lat, lon = area.frame.latlon_from_en(corners)
    box = [float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max())]
    query: Any = {"bbox": box, "limit": 100}  # per page: APIs allow at least as many
    query |= {"datetime": spec.options.time} if spec.options.time else {}
    query |= {"collections": [spec.options.layer]} if spec.options.layer else {}
    search = _link(web.get_json(spec.url), "search")
    if search is None:
        raise FetchError(f"not a STAC API with a search: {spec.url}")
    url = linked(spec.url, search["href"])
    for _ in range(MAX_PAGES):
        page = web.get_json(url, query)
        features = page.get("features")
        if not isinstance(features, list) or not all(isinstance(each, dict) for each in features):
            raise FetchError(f"answer is not a list of items: {url}")
        yield from ((feature, url) for feature in features)
        following = _link(page, "next")
        if following is None:
            return
        url = linked(url, following["href"])
        if str(following.get("method", "GET")).upper() == "POST":
            more, merged = following.get("body"), query if following.get("merge") else {}
            query = {**(merged or {}), **(more if isinstance(more, dict) else {})}
        else:
            query = None
    raise FetchError(f"list of items does not end: {spec.url}")


def _link(document: dict[str, Any], kind: str) -> dict[str, Any] | None:
    links = document.get("links")
    for link in links if isinstance(links, list) else ():
        if isinstance(link, dict) and link.get("rel") == kind:
            return link | {"href": str(link.get("href", ""))}
    return None


def _item(feature: dict[str, Any], where: str, options: ImageryOptions) -> tuple[str, str, str]:
    name, assets = str(feature.get("id", ""))[:200], feature.get("assets")
    plain = assets if isinstance(assets, dict) else {}
    known = {key: asset for key, asset in plain.items() if isinstance(asset, dict)}
    asset = known[_asset(known, options, name)]
    properties = feature.get("properties")
    times = properties if isinstance(properties, dict) else {}
    time = str(times.get("datetime") or times.get("start_datetime") or "")
    return time, name, linked(where, str(asset.get("href", "")))


def _asset(assets: dict[str, dict[str, Any]], options: ImageryOptions, name: str) -> str:
    """The asset requested, else the GeoTIFF of a usual name, the only one, or the coarsest that is
    fine enough."""
    if options.asset is not None:
        return choose(list(assets), options.asset, f"item {name} has no asset")
    kinds = re.compile(r"image/(tiff|vnd\.stac\.geotiff)|\.tiff?$", re.IGNORECASE)
    tiffs = {
        key: float(asset.get("gsd") or asset.get("eo:gsd") or 0)
        for key, asset in assets.items()
        if kinds.search(str(asset.get("type") or asset.get("href")).partition("?")[0])
        and not {"thumbnail", "metadata", "overview"} & set(asset.get("roles") or [])
    }
    if not tiffs:
        raise FetchError(f"item {name} has no GeoTIFF; available: {listed(list(assets))}")
    for usual in ("visual", "image", "ortho", "data", "rgb"):
        if usual in tiffs:
            return usual
    wanted_m = options.wanted_gsd_m
    fitting = {
        key: gsd_m for key, gsd_m in tiffs.items() if gsd_m > 0 and is_fine_enough(gsd_m, wanted_m)
    }
    if len(tiffs) > 1 and not fitting:
        raise FetchError(f"item {name} has {listed(list(tiffs))}; name one in a table (--services)")
    return max(fitting or tiffs, key=lambda key: tiffs[key])
