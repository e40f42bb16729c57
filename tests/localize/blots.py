"""A ground that is known at every point, an orthophoto and a map of it, and what cameras see of it.

The views are rendered by code that shares nothing with the program.
"""

import functools
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import Chances, RegisteredConfidence
from orthonav.core.localize.plan import DEFAULT_PLAN
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.manifest import TerrainInfo
from orthonav.core.records import Fix, Prior
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.build.calibrate import RegistrationCalibration
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area

SIDE_M = 620
ROUGH = TerrainInfo(
    *(0.0, 0.0, 1.0, 16, 16, 16, 0.0, 0.0, 0.1, 256, "surface", "none"),
    source_posting_m=1.0,
    roughness_m=2.0,
)
"""A terrain that was made of a surface model."""


class Flat:
    """Level ground, or a surface without houses."""

    def at_en_m(self, points_en_m):
        return np.zeros(np.shape(points_en_m)[:-1])


class Heights:
    """A raster as a layer of heights of a map gives it; NaN west of `from_m`."""

    def __init__(self, raster, from_m=-np.inf):
        self.raster, self.from_m = raster, from_m

    def at_en_m(self, points_en_m):
        points = np.asarray(points_en_m, float)
        found = self.raster.at(points[..., 0], points[..., 1])
        return np.where(points[..., 0] < self.from_m, np.nan, found)


CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
AGL_M = 150.0
FINEST_M = 0.5


def planned(**changes):
    """The usual plan of a search with other values."""
    return replace(DEFAULT_PLAN, **changes)


class Ground:
    """Grey levels of a ground of blots of many sizes, by metres east and north of its middle."""

    def __init__(self, seed=0, reach_m=560.0):
        self._seed, self._reach_m = seed, reach_m

    @functools.cached_property
    def _grey(self):
        rng = np.random.default_rng(self._seed)
        side = int(self._reach_m / FINEST_M) * 2
        grey = np.full((side, side), 128, np.float32)
        for sigma_m in (1.5, 4.0, 12.0):
            small = cv2.GaussianBlur(
                rng.standard_normal((side, side), np.float32), (0, 0), sigma_m / FINEST_M
            )
            grey += 17 * small / small.std()
        return grey

    def __call__(self, east_m, north_m):
        """The table is far finer than what it holds: a cubic spline between its pixels is it."""
        col, row = self._reach_m + np.asarray(east_m), self._reach_m - np.asarray(north_m)
        index = [np.float32(each / FINEST_M - 0.5) for each in (col, row)]
        return cv2.remap(self._grey, *index, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def as_grey(values):
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


@functools.lru_cache(maxsize=8)
def rays(camera):
    """Where its pixels look, (H W, 3) forward, right, down.

    Brown's model is undone by fixed-point iteration, the fisheye's by OpenCV."""
    cols, rows = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    seen_x = (cols.ravel() - camera.cx_px) / camera.fx_px
    seen_y = (rows.ravel() - camera.cy_px) / camera.fy_px
    right, down = seen_x, seen_y
    if camera.model == "fisheye":
        seen = np.stack([seen_x, seen_y], axis=-1)[:, None]
        plane = cv2.fisheye.undistortPoints(seen, np.eye(3), np.array(camera.distortion))
        right, down = plane[:, 0].T
    elif camera.distortion:
        k1, k2, p1, p2, k3 = (*camera.distortion, 0)[:5]
        for _ in range(60):
            r2, both = right**2 + down**2, 2 * right * down
            radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            right, down = (
                (seen_x - p1 * both - p2 * (r2 + 2 * right**2)) / radial,
                (seen_y - p1 * (r2 + 2 * down**2) - p2 * both) / radial,
            )
    return np.stack([-down, right, np.ones_like(right)], axis=-1)


def rendered(ground, place_en_m, attitude, agl_m=AGL_M, camera=CAMERA):
    """What the camera sees (H, W) uint8: forward-right-down body, Z-Y-X angles; white above the
    horizon."""
    shape = camera.height_px, camera.width_px
    north, east, down = Rotation.from_euler("ZYX", attitude, degrees=True).apply(rays(camera)).T
    depth = np.where(down > 1e-6, down, np.nan)
    north, east = (np.reshape(along / depth * agl_m, shape) for along in (north, east))
    seen = ground(place_en_m[0] + np.nan_to_num(east), place_en_m[1] + np.nan_to_num(north))
    return as_grey(np.where(np.isfinite(east), seen, 255))


GROUND = Ground()


class KnownMap(NamedTuple):
    """An orthophoto of the ground, a map of it with 1 m pixels, and the plane of the map."""

    ortho: Path
    path: Path
    frame: LocalFrame


def known_map(made_once, make_ortho):
    """The same for all processes that run tests; not to be changed."""

    def make(folder):
        _map_of(_ortho_of(make_ortho, folder), folder / "area.onav")

    folder = made_once("blots", make)
    ortho = folder / "2020-05.tif"
    return KnownMap(ortho, folder / "area.onav", _frame_of(ortho))


@pytest.fixture(scope="module")
def known_path(made_once, make_ortho):
    """The map file of `known_map`."""
    return known_map(made_once, make_ortho).path


@pytest.fixture(scope="module")
def known_localizer(made_once, make_ortho):
    return Localizer(open_map(known_map(made_once, make_ortho).path))


def _frame_of(ortho):
    outline = Mosaic.open([ortho]).outline_latlon_deg
    return Area.from_outline(outline[:, 0], outline[:, 1]).frame


def _ortho_of(make_ortho, folder):
    empty = np.ones((SIDE_M, SIDE_M), np.uint8)
    path = make_ortho(folder / "2020-05.tif", empty)
    frame = _frame_of(path)
    x, y = np.meshgrid(np.arange(SIDE_M) + 700_000.5, 6_599_999.5 - np.arange(SIDE_M))
    to_degrees = pyproj.Transformer.from_crs("EPSG:2154", "EPSG:4326", always_xy=True)
    lon, lat = to_degrees.transform(x.ravel(), y.ravel())
    east, north = np.reshape(frame.en_from_latlon(lat, lon).T, (2, SIDE_M, SIDE_M))
    return make_ortho(path, as_grey(GROUND(east, north)))


def _map_of(ortho, path):
    """The confidence is as maps of its kind learn it."""
    confidence = RegisteredConfidence.usual(Chances(18.0, 16.0, 30.0))
    learnt = RegistrationCalibration(confidence, 0.6)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthonav.ground.build.calibrate.CROPS", 16)
        patch.setattr("orthonav.ground.build.build.calibrate_registration", lambda *_: learnt)
        build_map(BuildRequest([ortho], path, tile_px=128, overlap=0.75, gsd_m=1.0))


def place_of(localizer, fix):
    assert isinstance(fix, Fix), fix
    return localizer.sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)


def error_m(localizer, fix, place_en_m):
    return float(np.hypot(*(place_of(localizer, fix) - place_en_m)))


def prior_at(localizer, place_en_m, std_m):
    lat, lon = localizer.sheet.frame.latlon_from_en(place_en_m)
    return Prior(float(lat), float(lon), std_m)
