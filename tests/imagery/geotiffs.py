"""Small georeferenced rasters for the tests of imagery, around one place."""

import functools
import math
import warnings

import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine

from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.imagery.mosaic import Mosaic

# On the central meridian of Lambert-93: grid north is true north, the scale off by 0.1 %, so a
# sheet laid on a raster of this projection is that raster, pixel by pixel.
FRAME = LocalFrame(46.5, 3.0)
LAMBERT = "EPSG:2154"
SIZE = 120


@functools.cache
def from_local(crs, frame=FRAME):
    """PROJ's way from the sheet's plane to a coordinate system, which takes 10 ms to make."""
    return Transformer.from_crs(frame.proj4, crs, always_xy=True)


def placed(crs=LAMBERT, gsd_m=1.0, size=SIZE, turn_deg=0.0, frame=FRAME):
    """Geotransform of a square raster around the frame's centre, `gsd_m` true metres a pixel."""
    x, y = from_local(crs, frame).transform(0, 0)
    east, _ = from_local(crs, frame).transform(1, 0)
    unit = abs(east - x) if turn_deg == 0 else 1.0
    return (
        Affine.translation(x, y)
        * Affine.rotation(turn_deg)
        * Affine.scale(gsd_m * unit, -gsd_m * unit)
        * Affine.translation(-size / 2, -size / 2)
    )


def write(path, bands, *, crs=LAMBERT, transform=None, colours=None, mask=None, **profile):
    """Write bands (C, H, W) as a raster, with a mask (H, W) inside the file where given."""
    count, height, width = bands.shape
    if transform is None:
        transform = placed(size=width)
    profile = {"driver": "GTiff", "dtype": bands.dtype, "photometric": None} | profile
    with warnings.catch_warnings(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            path,
            "w",
            count=count,
            height=height,
            width=width,
            crs=crs,
            transform=transform,
            **{key: value for key, value in profile.items() if value is not None},
        ) as data:
            data.write(bands)
            if colours is not None:
                data.colorinterp = colours
            if mask is not None:
                data.write_mask(mask)
    return path


def smooth_scene(size=SIZE, seed=0, low=40, high=215):
    """Three unlike waves (3, H, W) uint8, slow enough to survive resampling."""
    y, x = np.mgrid[:size, :size] + 0.5
    phase = np.random.default_rng(seed).uniform(0, 2 * math.pi, 3)
    waves = [np.sin(x / 9 + phase[0]), np.sin(y / 11 + phase[1]), np.sin((x + y) / 13 + phase[2])]
    return np.rint((np.stack(waves) + 1) / 2 * (high - low) + low).astype(np.uint8)


def sheet_of(paths, size=SIZE, gsd_m=1.0, frame=FRAME):
    """The sheet raster around the frame's centre, `size` pixels across."""
    half_m = size * gsd_m / 2
    mosaic = Mosaic.open(paths if isinstance(paths, list) else [paths])
    return mosaic.sheet(
        frame, west_m=-half_m, north_m=half_m, width_px=size, height_px=size, gsd_m=gsd_m
    )


def read(paths, size=SIZE, gsd_m=1.0, frame=FRAME):
    """The whole of that sheet in one window."""
    with sheet_of(paths, size, gsd_m, frame) as sheet:
        return sheet.read(0, 0, size, size)


def centres_en_m(size, gsd_m):
    """East and north, each (size, size), of the sheet's pixel centres."""
    along = (np.arange(size) + 0.5 - size / 2) * gsd_m
    return np.meshgrid(along, -along)
