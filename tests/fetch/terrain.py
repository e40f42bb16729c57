"""A ground known everywhere by formula, so that every pixel of every service can be checked."""

import io
import json
from functools import cache

import numpy as np
import rasterio
import rasterio.shutil
from PIL import Image
from pyproj import Transformer
from rasterio.transform import Affine
from rasterio.windows import Window

LAT_DEG, LON_DEG = 46.5, 3.05
EAST_M, NORTH_M = 76_700.0, 111_170.0
"""Metres per degree there, as good as a formula needs to be."""
WAVES_M = ((61.0, 83.0, 0.3), (47.0, -71.0, 1.1), (-97.0, 53.0, 2.0))


@cache
def _to_degrees(crs):
    return Transformer.from_crs(crs, "EPSG:4326", always_xy=True)


def colours(x, y, crs):
    """Red, green, blue (..., 3) as floats at coordinates of `crs`."""
    lon, lat = (x, y) if crs == "EPSG:4326" else _to_degrees(crs).transform(x, y)
    east, north = (lon - LON_DEG) * EAST_M, (lat - LAT_DEG) * NORTH_M
    phases = [east / a + north / b + c + east * north / 4e5 for a, b, c in WAVES_M]
    return 128 + 90 * np.sin(2 * np.pi * np.stack(phases, axis=-1))


def picture(west, south, east, north, width, height, crs):
    """Pixels (H, W, 3) uint8 of a box, each the colour at its centre."""
    x = west + (np.arange(width) + 0.5) * (east - west) / width
    y = north - (np.arange(height) + 0.5) * (north - south) / height
    return np.rint(colours(*np.meshgrid(x, y), crs)).astype(np.uint8)


def encoded(pixels, kind="PNG", **options):
    """The bytes of a picture."""
    stream = io.BytesIO()
    options = {"compress_level": 1} | options if kind == "PNG" else options
    Image.fromarray(pixels).save(stream, kind, **options)
    return stream.getvalue()


def mercator_tile(zoom, row, col, size=256):
    """Pixels of a tile of the usual web grid."""
    half = np.pi * 6378137
    width = 2 * half / 2**zoom
    west, north = col * width - half, half - row * width
    return picture(west, north - width, west + width, north, size, size, "EPSG:3857")


def bounds(half_m=300.0):
    """West, south, east, north in degrees of a square around the middle."""
    lon, lat = half_m / EAST_M, half_m / NORTH_M
    return LON_DEG - lon, LAT_DEG - lat, LON_DEG + lon, LAT_DEG + lat


def write_tif(path, crs, gsd_m=1.0, size=700, driver="GTiff", hole=None, bands=3, **options):
    """A file of the ground around the middle, on whole multiples of its pixels."""
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(LON_DEG, LAT_DEG)
    west = round(x / gsd_m - size / 2) * gsd_m + options.pop("east_m", 0.0)
    north = round(y / gsd_m + size / 2) * gsd_m + options.pop("north_m", 0.0)
    pixels = picture(west, north - size * gsd_m, west + size * gsd_m, north, size, size, crs)
    raw = path.with_suffix(".raw.tif")
    profile = {"driver": "GTiff", "width": size, "height": size, "count": bands, "crs": crs}
    transform = Affine(gsd_m, 0, west, 0, -gsd_m, north)
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(raw, "w", dtype="uint8", transform=transform, **profile) as data,
    ):
        stacked = pixels.transpose(2, 0, 1)
        data.write(np.concatenate([stacked, 255 - stacked])[:bands])
        if hole is not None:
            mask = np.full((size, size), 255, np.uint8)
            mask[hole] = 0
            data.write_mask(mask)
    if driver == "COG":
        rasterio.shutil.copy(raw, path, driver="COG", COMPRESS="DEFLATE", BLOCKSIZE=256, **options)
    else:
        rasterio.shutil.copy(raw, path, driver=driver, **options)
    raw.unlink()
    return path


def offset_px(path, crs=None, window_px=200):
    """How far (columns, rows) the picture of a file is off the ground, in its own pixels, the
    largest difference in colour that is left, and the share of valid pixels.

    Looked at in three windows: two corners and the middle. First order: the difference is the shift
    times the slope, solved for over all valid pixels.
    """
    with rasterio.open(path) as data:
        mask = data.dataset_mask() > 0
        found = [_differences(data, share, window_px, mask, crs) for share in (0.0, 0.5, 1.0)]
    slopes, off = (np.concatenate(parts) for parts in zip(*found, strict=True))
    shift = np.linalg.lstsq(slopes, -off, rcond=None)[0]
    return shift, float(np.abs(off).max()), float(mask.mean())


def _differences(data, share, size, mask, crs):
    """Slopes (N, 2) and differences (N,) of the valid pixels of a window."""
    width, height = min(size, data.width), min(size, data.height)
    left, top = round(share * (data.width - width)), round(share * (data.height - height))
    window = Window(left, top, width, height)
    found = data.read([1, 2, 3], window=window).transpose(1, 2, 0).astype(float)
    valid = mask[window.toslices()]
    cols, rows = np.meshgrid(left + np.arange(width) + 0.5, top + np.arange(height) + 0.5)
    expected = colours(*(data.transform * (cols, rows)), crs or data.crs.to_string())
    slopes = [np.gradient(expected, axis=axis)[valid].ravel() for axis in (1, 0)]
    return np.stack(slopes, axis=1), (found - expected)[valid].ravel()


def tags(path):
    """What a file says of itself."""
    with rasterio.open(path) as data:
        return data.tags()


def item(name, href, box, time="2021-06-15T10:00:00Z", **asset):
    """A STAC item with one file."""
    kind = "image/tiff; application=geotiff; profile=cloud-optimized"
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "id": name,
        "bbox": list(box),
        "geometry": None,
        "properties": {"datetime": time},
        "links": [],
        "assets": {"data": {"href": href, "type": kind, **asset}},
    }


def heights(lat_deg, lon_deg):
    """Metres: they rise to the north and to the east, and pass through 0."""
    north, east = np.asarray(lat_deg) - LAT_DEG, np.asarray(lon_deg) - LON_DEG
    return 40 + 0.1 * north * NORTH_M - 0.2 * east * EAST_M


def height_cog(folder, name, values, crs, transform, **options):
    """The bytes of a file of heights with -9999 for none, and its bounds."""
    raw, path = folder / f"{name}.raw.tif", folder / f"{name}.tif"
    profile = {"width": values.shape[1], "height": values.shape[0], "count": 1, "nodata": -9999}
    with rasterio.open(
        raw, "w", driver="GTiff", dtype="float32", crs=crs, transform=transform, **profile
    ) as data:
        data.write(values.astype(np.float32)[None])
        box = tuple(data.bounds)
    rasterio.shutil.copy(raw, path, driver="COG", **options)
    return path.read_bytes(), box


def height_files(folder):
    """Two files of heights in degrees, as those of Copernicus, with a hole, and their items by
    name; the step, and the corner of the eastern one."""
    step = 1 / 3600
    west = round(LON_DEG / step) * step
    north = round(LAT_DEG / step) * step + 20 * step
    found = {}
    for name, first in (("west", west - 40 * step), ("east", west)):
        col, row = np.meshgrid(np.arange(40) + 0.5, np.arange(40) + 0.5)
        values = heights(north - row * step, first + col * step)
        if name == "east":
            values[18:20, 5:8] = -9999
        place = Affine(step, 0, first, 0, -step, north)
        body, box = height_cog(folder, name, values, "EPSG:4326", place, COMPRESS="DEFLATE")
        found |= {f"/{name}.tif": body, name: item(name, f"./{name}.tif", box)}
    return found, step, west, north


def surface_file(folder):
    """One file of heights at 0.5 m in LV95, as those of swissSURFACE3D, and its item by name."""
    to_crs = Transformer.from_crs("EPSG:4326", "EPSG:2056", always_xy=True)
    size, (x, y) = 1024, to_crs.transform(LON_DEG, LAT_DEG)
    west, north = round(x) - size / 4, round(y) + size / 4
    steps = (np.arange(size) + 0.5) / 2
    lon, lat = _to_degrees("EPSG:2056").transform(*np.meshgrid(west + steps, north - steps))
    place, options = Affine(0.5, 0, west, 0, -0.5, north), {"OVERVIEW_RESAMPLING": "AVERAGE"}
    values = heights(lat, lon)
    body, _ = height_cog(folder, "town", values, "EPSG:2056", place, COMPRESS="LZW", **options)
    return {"/town.tif": body, "town": item("town", "./town.tif", bounds(256))}


def plain(value):
    """JSON as bytes."""
    return json.dumps(value).encode()
