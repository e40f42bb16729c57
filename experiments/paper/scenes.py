"""What is flown over, two orthophotos of two dates, and the views, cut from the later one.

The paper's numbers of views are those of tile steps along its trajectories, and its figures at 15 m
can only be had where views lie on the tile grid. So every figure here comes for views *along the
route*, at most one per tile step, for views *on the grid* all over the search band, and *anywhere*.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.scenes import SCENES
from lab.landscape import DEFAULT_DATES, generate_area
from numpy.typing import NDArray

from experiments.paper.methods import (
    REDUCED_NETWORKS,
    TABLE_1,
    TILE_PX,
    VIEW_ROOM,
    Setting,
    Trajectory,
    column,
    two_tiles,
)
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.records import Telemetry
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Extent
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate.render import ViewEffects, render_view

Array = NDArray[np.float64]
SEED = 1
AGL_M = 2000.0
"""Reported height over imagery that no trajectory of the paper is flown over; any would do."""
REAL = {
    "naip-2012": ("naip", "20090818", "20120731"),
    "naip-2018": ("naip", "20090818", "20180716"),
    **{f"szada-{n}": (f"szada_{n}", f"szada_{n}_a", f"szada_{n}_b") for n in "157"},
}
"""Scene of the catalogue, dates of the map and of the views."""
REDUCED_REAL = ("naip-2018", "szada-1", "szada-7")
UNTUNED = {
    "garching": ("garching", "2009_04", "2015_04"),
    "schiphol": ("schiphol", "2008_05", "2018_04"),
    "solar_farm": ("solar_farm", "2017_12", "2020_12"),
    "atlanta": ("atlanta", "2016_12", "2021_08"),
    "aral": ("aral", "2012_12", "2020_12"),
    "tours": ("tours", "1964", "1976"),
}
"""Scenes on which nothing was tuned but the confidence of registered views."""
VIEWS, MOST_VIEWS = {"A": 625, "B": 500, "C": 300, "D": 84}, 500
"""Numbers of views that most shares of the paper's Table 2 are multiples of (the triplet's have one
less); most views along the route of other scenes."""


@dataclass(frozen=True)
class Scene:
    """A trajectory over the imagery of two dates: the map is made of `past`, views of `present`.

    `others`: further dates, for what learns from several; never that of the views.
    """

    name: str
    past: Path
    present: Path
    trajectory: Trajectory
    others: tuple[Path, ...] = ()

    @property
    def imagery(self) -> tuple[Path, ...]:
        return self.past, self.present, *self.others

    def of(self, setting: Setting) -> "Scene":
        """The scene as a setting runs it: a dry run has two tiles."""
        return replace(self, trajectory=two_tiles(self.trajectory)) if setting.dry else self

    def area(self) -> dict[str, Any]:
        """The search band in the middle of the imagery, as `BuildRequest` takes an area.

        A rectangle; where that is narrower than a tile, a band around the trajectory.
        """
        flown = self.trajectory
        frame, (west, south, east, north) = _outline(self.past)
        middle = np.array([west + east, south + north]) / 2
        half = np.array([flown.length_m, flown.band_m]) / 2
        if flown.band_m < TILE_PX * flown.gsd_m:
            ends = middle + np.array([[-half[0], 0.0], [half[0], 0.0]])
            lat, lon = frame.latlon_from_en(ends)
            waypoints = tuple(zip(lat.tolist(), lon.tolist(), strict=True))
            return {"route": Route(waypoints), "band_m": flown.band_m}
        return {"bounds_deg": _box_deg(frame, middle - half, middle + half)}


def generated(setting: Setting, name: str, folder: Path, gsd_m: float | None = None) -> Scene:
    """A trajectory of Table 1 over an area that `render` generates.

    Of two dates, and a third where a triplet network is trained. `gsd_m`: another ground
    resolution; the scene is then named by it.
    """
    trajectory = setting.trajectory(name)
    title = name
    if gsd_m is not None and gsd_m != trajectory.gsd_m:
        trajectory = replace(trajectory, gsd_m=gsd_m)
        title = f"{name}-{gsd_m:g}m"
    east_m, north_m = trajectory.imagery_m
    place = folder / f"{name}-{east_m:.0f}x{north_m:.0f}m-{trajectory.gsd_m:g}m"
    reduced = "".join(REDUCED_NETWORKS["triplet"].values())
    learns = setting.name == "full" or (setting.name in ("reduced", "epochs") and name in reduced)
    dates = DEFAULT_DATES if learns else DEFAULT_DATES[:2]
    paths = [place / f"{date.name}.tif" for date in dates]
    return Scene(title, paths[0], paths[1], trajectory, tuple(paths[2:]))


def render(scene: Scene) -> None:
    """Generate the imagery of a scene, unless it is there."""
    if all(path.is_file() for path in scene.imagery):
        return
    flown, names = scene.trajectory, [path.stem for path in scene.imagery]
    dates = [date for date in DEFAULT_DATES if date.name in names]
    folder = scene.past.parent
    generate_area(folder, size_m=flown.imagery_m, gsd_m=flown.gsd_m, dates=dates, seed=SEED)


def over(
    name: str, past: Path, present: Path, gsd_m: float | None = None, others: tuple[Path, ...] = ()
) -> Scene:
    """The same protocol over two orthophotos: all of the first that holds whole views."""
    mosaic = Mosaic.open([past])
    pixel_m = gsd_m or float(f"{mosaic.gsd_m:.3g}")
    empty = Trajectory(name, AGL_M, 1.0, 1.0, TABLE_1["B"].overlap, pixel_m)
    _, (west, south, east, north) = _outline(past)
    sides = [side - 2 * empty.margin_m for side in (east - west, north - south)]
    if min(sides) <= 0:
        raise ValueError(
            f"imagery of {east - west:.0f} x {north - south:.0f} m is too small for tiles of "
            f"{TILE_PX * pixel_m:.0f} m and turned views; give a finer ground resolution: {past}"
        )
    length_m, band_m = (math.floor(side) for side in sides)
    made = Trajectory(name, AGL_M, length_m, band_m, empty.overlap, pixel_m)
    return Scene(name, past, present, made, others)


def real(data: Path, names: Iterable[str]) -> Iterator[Scene]:
    """Scenes of the optional real imagery, those that are there.

    All other dates of the catalogue are for what learns from several.
    """
    for name in names:
        place, past, present = (REAL | UNTUNED)[name]
        dates = [each for each in SCENES[place].dates if each not in (past, present)]
        first, second, *others = (data / SCENES[place].file(d) for d in (past, present, *dates))
        if first.is_file() and second.is_file():
            yield over(name, first, second, others=tuple(others))


def _outline(path: Path) -> tuple[LocalFrame, Extent]:
    """Plane and extent of imagery, which may be larger than a sheet of a map."""
    corners = Mosaic.open([path]).outline_latlon_deg
    frame = LocalFrame(*((corners.min(axis=0) + corners.max(axis=0)) / 2).round(7).tolist())
    points = frame.en_from_latlon(corners[:, 0], corners[:, 1])
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    return frame, (float(west), float(south), float(east), float(north))


def _box_deg(frame: LocalFrame, low: Array, high: Array) -> tuple[float, float, float, float]:
    middle = (low + high) / 2
    sides = np.array(
        [[low[0], middle[1]], [high[0], middle[1]], [middle[0], low[1]], [middle[0], high[1]]]
    )
    lat, lon = frame.latlon_from_en(sides)
    return float(lon[0]), float(lat[2]), float(lon[1]), float(lat[3])


VIEW_SEED = 7
PLACEMENTS = ("route", "grid", "anywhere")
NO_EFFECTS = ViewEffects(exposure_std=0.0, blur_px=0.0, noise_std=0.0, jpeg_quality=100)
REPORTED_HEADING_STD_DEG = 0.001
"""With this deviation only the reported heading is tried."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Imagery of the later date (H, H, 3) around the place `truth_en_m` (2,) of a view."""

    truth_en_m: Array
    rgb: NDArray[np.uint8]


def places_en_m(centres_en_m: NDArray[np.floating[Any]], count: int) -> Array:
    """Places (count, 2) along the trajectory, evenly spaced, anywhere across the search band."""
    low, high = centres_en_m.min(axis=0), centres_en_m.max(axis=0)
    rng = np.random.default_rng(VIEW_SEED)
    along = low[0] + (np.arange(count) + rng.random(count)) / count * (high[0] - low[0])
    return np.stack([along, rng.uniform(low[1], high[1], count)], axis=1)


def on_grid(places: Array, centres_en_m: NDArray[np.floating[Any]]) -> Array:
    """The nearest tile centre of each place (N, 2)."""
    away = places[:, None] - centres_en_m[None].astype(np.float64)
    nearest = (away**2).sum(axis=2).argmin(axis=1)
    return np.asarray(centres_en_m[nearest], dtype=np.float64)


def most_views(scene: str) -> int:
    """Most views along the route of a scene."""
    return VIEWS.get(column(scene), MOST_VIEWS)


def along_route(centres_en_m: NDArray[np.floating[Any]], most: int) -> Array:
    """Tile centres (N, 2) of the line along the middle of the search band, evenly thinned."""
    lines = np.unique(centres_en_m[:, 1])
    line = lines[np.abs(lines - (lines[0] + lines[-1]) / 2).argmin()]
    places = centres_en_m[centres_en_m[:, 1] == line].astype(np.float64)
    places = places[np.argsort(places[:, 0])]
    chosen = np.linspace(0, len(places) - 1, min(most, len(places))).round().astype(int)
    return np.asarray(places[chosen])


def grounds(scene: Scene, localizer: Localizer, places: Array) -> list[Ground]:
    """What the later date shows around places (N, 2); those without whole imagery are left out."""
    side_px, gsd_m = 2 * round(VIEW_ROOM * TILE_PX / 2), localizer.grid.gsd_m
    half_m = side_px * gsd_m / 2
    mosaic, found = Mosaic.open([scene.present]), []
    for place in places:
        west_m, north_m = float(place[0] - half_m), float(place[1] + half_m)
        size = {"width_px": side_px, "height_px": side_px}
        sheet = mosaic.sheet(
            localizer.sheet.frame, west_m=west_m, north_m=north_m, gsd_m=gsd_m, **size
        )
        with sheet as raster:
            pixels = raster.read(0, 0, side_px, side_px)
        if pixels.valid.all():
            found.append(Ground(place, pixels.rgb))
    return found


def reference_tiles(scene: Scene, localizer: Localizer) -> list[NDArray[np.uint8]]:
    """Grey levels (256, 256) of all tiles, of the date of the map."""
    grid = localizer.grid
    with Mosaic.open([scene.past]).grid_sheet(localizer.sheet.frame, grid) as raster:
        grey = raster.read(0, 0, grid.width_px, grid.height_px).grey
    corners = grid.tiles_rc(localizer.tiles.centres_en_m) * grid.stride_px
    return [grey[row : row + TILE_PX, col : col + TILE_PX] for row, col in corners.tolist()]


def grid_views(
    scene: Scene, localizer: Localizer, count: int
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """The views on the grid: number of the tile, and grey levels."""
    centres = localizer.tiles.centres_en_m
    for ground in grounds(scene, localizer, on_grid(places_en_m(centres, count), centres)):
        tile = int(np.hypot(*(centres - ground.truth_en_m).T).argmin())
        yield tile, view_of(ground, scene.trajectory.agl_m, localizer.grid.gsd_m)


def camera_of(agl_m: float, gsd_m: float) -> Camera:
    """The camera whose views from `agl_m` are exactly one tile."""
    focal, middle = agl_m / gsd_m, TILE_PX / 2
    return Camera(TILE_PX, TILE_PX, focal, focal, middle, middle)


def view_of(
    ground: Ground, agl_m: float, gsd_m: float, *, turned_deg: float = 0.0, drop_m: float = 0.0
) -> NDArray[np.uint8]:
    """Grey view (256, 256) from the place, with these errors of heading and height."""
    camera, half_m = camera_of(agl_m, gsd_m), ground.rgb.shape[0] * gsd_m / 2
    attitude = (turned_deg, 0.0, 0.0, agl_m - drop_m)
    corner = np.array([-half_m, half_m])
    rng = np.random.default_rng(0)
    seen = render_view(camera, attitude, ground.rgb, corner, gsd_m, NO_EFFECTS, rng)
    return np.asarray(cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def telemetry_at(agl_m: float, *, exact: bool = True) -> Telemetry:
    """Telemetry of every view: north up, nominal height, straight down without an error of pitch
    and roll; `exact` tries no other heading."""
    std = REPORTED_HEADING_STD_DEG if exact else None
    return Telemetry(0, 0.0, 0.0, 0.0, agl_m, yaw_std_deg=std, tilt_std_deg=0.0)
