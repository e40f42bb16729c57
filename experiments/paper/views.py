"""The paper's section Dataset: UAV views along the trajectory, cut from imagery of another date.

The paper's numbers of views are those of tile steps along its trajectories, and its figures at 15 m
can only be had where views lie on the tile grid. So every figure here comes for views *along the
route*, one per tile step, for views *on the grid* all over the search band, and *anywhere*.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from experiments.paper.scenes import Scene
from experiments.paper.trajectories import TILE_PX, VIEW_ROOM
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.records import Telemetry
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.simulate.render import ViewEffects, render_view

SEED = 7
PLACEMENTS = ("route", "grid", "anywhere")
NO_EFFECTS = ViewEffects(exposure_std=0.0, blur_px=0.0, noise_std=0.0, jpeg_quality=100)
HEADING_TOLD_DEG = 0.001
"""With this deviation only the reported heading is tried."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ground:
    """Imagery of the later date (H, H, 3) around the place `truth_en_m` (2,) of a view."""

    truth_en_m: Array
    rgb: NDArray[np.uint8]


def places_en_m(centres_en_m: NDArray[np.floating[Any]], count: int) -> Array:
    """Places (count, 2) along the trajectory, evenly spaced, anywhere across the search band."""
    low, high = centres_en_m.min(axis=0), centres_en_m.max(axis=0)
    rng = np.random.default_rng(SEED)
    along = low[0] + (np.arange(count) + rng.random(count)) / count * (high[0] - low[0])
    return np.stack([along, rng.uniform(low[1], high[1], count)], axis=1)


def on_grid(places: Array, centres_en_m: NDArray[np.floating[Any]]) -> Array:
    """The nearest tile centre of each place (N, 2)."""
    away = places[:, None] - centres_en_m[None].astype(np.float64)
    nearest = (away**2).sum(axis=2).argmin(axis=1)
    return np.asarray(centres_en_m[nearest], dtype=np.float64)


def along_route(centres_en_m: NDArray[np.floating[Any]], most: int) -> Array:
    """Tile centres (N, 2) of the line along the middle of the search band, evenly thinned."""
    lines = np.unique(centres_en_m[:, 1])
    line = lines[np.abs(lines - (lines[0] + lines[-1]) / 2).argmin()]
    places = centres_en_m[centres_en_m[:, 1] == line].astype(np.float64)
    places = places[np.argsort(places[:, 0])]
    chosen = np.linspace(0, len(places) - 1, min(most, len(places))).round().astype(int)
    return np.asarray(places[chosen])


def grounds(scene: Scene, frame: LocalFrame, grid: TileGrid, places: Array) -> list[Ground]:
    """What the later date shows around places (N, 2); those without whole imagery are left out."""
    side_px = 2 * round(VIEW_ROOM * TILE_PX / 2)
    half_m = side_px * grid.gsd_m / 2
    mosaic, found = Mosaic.open([scene.present]), []
    for place in places:
        west, north = place[0] - half_m, place[1] + half_m
        with mosaic.sheet(
            frame,
            west_m=float(west),
            north_m=float(north),
            width_px=side_px,
            height_px=side_px,
            gsd_m=grid.gsd_m,
        ) as raster:
            pixels = raster.read(0, 0, side_px, side_px)
        if pixels.valid.all():
            found.append(Ground(place, pixels.rgb))
    return found


def camera_of(agl_m: float, gsd_m: float) -> Camera:
    """The camera whose views from `agl_m` are exactly one tile."""
    focal, middle = agl_m / gsd_m, TILE_PX / 2
    return Camera(TILE_PX, TILE_PX, focal, focal, middle, middle)


def view_of(
    ground: Ground,
    camera: Camera,
    agl_m: float,
    gsd_m: float,
    *,
    turned_deg: float = 0.0,
    drop_m: float = 0.0,
) -> NDArray[np.uint8]:
    """Grey view (256, 256) from the place, with these errors of heading and height."""
    half_m = ground.rgb.shape[0] * gsd_m / 2
    attitude = (turned_deg, 0.0, 0.0, agl_m - drop_m)
    corner = np.array([-half_m, half_m])
    rng = np.random.default_rng(0)
    seen = render_view(camera, attitude, ground.rgb, corner, gsd_m, NO_EFFECTS, rng)
    return np.asarray(cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def telemetry_at(agl_m: float, *, exact: bool = True) -> Telemetry:
    """Telemetry of every view: north up, nominal height, straight down without an error of pitch
    and roll; `exact` tries no other heading."""
    std = HEADING_TOLD_DEG if exact else None
    return Telemetry(0, 0.0, 0.0, 0.0, agl_m, yaw_std_deg=std, tilt_std_deg=0.0)
