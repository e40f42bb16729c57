"""Views over hills, localized on level ground and on the terrain of the map, right or wrong.

`python -m benchmarks.over_terrain [--part slopes wrong oblique] [--views 30] [--areas SEED ..]`
drapes imagery of another date over generated hills, renders perspective views, and localizes them.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from lab.terrain import random_relief, seen_view
from numpy.typing import ArrayLike, NDArray

from benchmarks.faults import middle_of
from benchmarks.record import Section, Table, percent, quantiles, run, say
from benchmarks.scenes import DATA, PAST, PRESENT, SCENES, Pair, area, map_of
from orthonav.cli.source import map_heights
from orthonav.core.geo.camera import Camera, enu_from_camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.localize.ground import GroundModel
from orthonav.core.mapfile import MapFile, open_map
from orthonav.core.records import CONFIDENT, Fix, NoFix, Telemetry, View
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.simulate.render import Raster

PARTS = ("slopes", "wrong", "oblique")
WRONG = ("", "displaced by 200 m", "50 m too high", "with holes")
POSTING_M, FINER = 10.0, 4
"""That of a usual terrain layer; views are rendered over heights four times as fine."""
YAW_STD_DEG, AGL_STD, TILT_STD_DEG = 5.0, 0.05, 3.0
"""Errors of heading and of a measured height; pitch and roll vary so far and are reported."""
FIELD, BASE_M, MAP_M, SIDE_M = 0.96, 200.0, 2000, 4000
"""Metres that a camera sees for each metre of height; height of the ground; sides of the generated
map and of the ground around it."""
NEAR_PX = 5  # of the map: positions within are correct
MAX_OFF_NADIR_DEG = 65.0
"""Views farther off nadir are refused, and not drawn."""
HEADER = (
    *("views", "slope", "off nadir", "localized on", "correct", "accepted of correct", "false"),
    *("median m", "CPU ms"),
)
Array = NDArray[np.float64]
Locate = Callable[[View], Fix | NoFix]


@dataclass(frozen=True)
class Row:
    """Imagery, views and terrain of a row.

    `pair`: None for generated imagery. `tilt_deg`: angle off nadir, forwards. `measured`: height
    above ground is measured, else heights above sea and take-off are. `wrong`: one of `WRONG`.
    """

    part: str
    pair: Pair | None
    view_px: int
    slope: float
    shortest_m: float = 300.0
    measured: bool = False
    tilt_deg: float = 0.0
    wrong: str = ""

    @property
    def agl_m(self) -> float | None:
        """Height of oblique views; others have one that fits their pixels to the map's."""
        return 250.0 if self.part == "oblique" else None


class Terrain:
    """Heights of a raster in the plane of a sheet, with something wrong, as a layer gives them."""

    def __init__(self, frame: LocalFrame, raster: Raster, wrong: str) -> None:
        self.frame, self._raster, self._wrong = frame, raster, wrong
        rows, cols = raster.values.shape
        size = np.array([cols, -rows]) * raster.pixel_m
        middle = np.array([raster.west_m, raster.north_m]) + size / 2
        self.middle_en_m: Array = middle
        holes = np.random.default_rng(7).uniform(-0.5, 0.5, (8, 2))
        self._holes = middle + holes * size

    def at_en_m(self, points_en_m: ArrayLike) -> Array:
        """Heights (...) at points (..., 2); NaN outside and in holes."""
        points = np.asarray(points_en_m, np.float64)
        if self._wrong == "displaced by 200 m":
            points = points - [200.0, 0.0]
        heights = np.asarray(self._raster.at(points[..., 0], points[..., 1]), np.float64)
        heights = np.where(self._raster.holds(points), heights, np.nan)
        if self._wrong == "50 m too high":
            heights = heights + 50.0
        for middle in self._holes if self._wrong == "with holes" else ():
            heights = np.where(np.abs(points - middle).max(axis=-1) < 200, np.nan, heights)
        return heights

    def __call__(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """Heights (...) at positions (...)."""
        return self.at_en_m(self.frame.en_from_latlon(lat_deg, lon_deg))


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--views", type=int, default=30, help="views of a row and area")
    parser.add_argument("--seed", type=int, default=1, help="of hills and views")
    parser.add_argument("--areas", type=int, nargs="+", default=[3], help="generated imagery")


def measure(options: argparse.Namespace) -> Section:
    chosen = [row for row in _rows() if row.part in options.part]
    rows = [line for row in chosen for line in _lines(row, options)]
    notes = (
        "no prior, heading off by 5 deg (standard deviation), imagery of another date over random "
        f"hills; correct: camera within 15 m or {NEAR_PX} px of the map, off nadir within 25 m or "
        "3 % of the distance",
    )
    return Section("Over terrain", [Table("Views of hills", HEADER, rows, notes)])


def _rows() -> Iterator[Row]:
    szada = SCENES["szada_1"].pair("szada_1_a", "szada_1_b")
    naip = SCENES["naip"].pair("20090818", "20180716")
    fine = szada if szada.is_there else None
    for slope in (0.0, 0.2, 0.3):
        yield Row("slopes", fine, 256, slope, measured=True)
        yield Row("slopes", fine, 128, slope)
        if naip.is_there:
            yield Row("slopes", naip, 256, slope, 600.0)
    for wrong in WRONG:
        yield Row("wrong", fine, 192, 0.2, wrong=wrong)
    for tilt in (30.0, 45.0, 60.0):
        yield Row("oblique", None, 480, 0.15, tilt_deg=tilt)


def _lines(row: Row, options: argparse.Namespace) -> Iterator[list[str]]:
    """Lines of the views over all areas together; real imagery is one area."""
    found: dict[str, list[list[float]]] = {}
    for seed in options.areas if row.pair is None else options.areas[:1]:
        opened, grey = _ground(row, options.work, seed)
        views = 3 if options.quick else options.views
        hills = _hills(row, grey, options.seed)
        rng = np.random.default_rng(options.seed)
        seen = [_seen(row, opened, grey, hills, rng) for _ in range(views)]
        for way, locate in _ways(row, opened, hills):
            if way == "terrain" or not row.wrong:
                frame = opened.manifest.sheets[0].frame
                placed = [_placed(locate, frame, *each) for each in seen]
                found.setdefault(way, []).extend(placed)
    for way, placed in found.items():
        errors_m, confidences, took_ms, ranges_m = np.array(placed, np.float64).T
        near_m = max(15.0, NEAR_PX * opened.manifest.sheets[0].grid.gsd_m)
        limits = np.maximum(25.0, 0.03 * ranges_m) if row.part == "oblique" else near_m
        right, confident = errors_m <= limits, confidences >= CONFIDENT
        height = "measured" if row.measured else "above sea"
        line = [
            f"{len(placed)} of {opened.manifest.sheets[0].grid.gsd_m:.3g} m, {row.view_px} px, "
            f"height {height}",
            *(f"{row.slope:g}", f"{row.tilt_deg:.0f}"),
            f"{way} {row.wrong}".strip(),
            percent(float(right.mean())),
            percent(float((confident & right).sum() / max(right.sum(), 1))),
            str(int((confident & ~right).sum())),
            *quantiles(errors_m[right], 50),
            *quantiles(took_ms, 50),
        ]
        say("  ".join(line))
        yield line


def _ground(row: Row, work: Path, seed: int) -> tuple[MapFile, Raster]:
    """The map, and imagery of another date in its plane; generated imagery reaches beyond the map,
    because cameras far off nadir see that."""
    if row.pair is None:
        past, present = (area(work, date, side_m=SIDE_M, seed=seed) for date in (PAST, PRESENT))
        past, beyond = middle_of(past, MAP_M, work / f"middle-{seed}.tif"), (SIDE_M - MAP_M) // 2
    else:
        (past, present), beyond = (DATA / each for each in (row.pair.map, row.pair.views)), 0
    opened = open_map(map_of(past, work))
    grid, frame = opened.manifest.sheets[0].grid, opened.manifest.sheets[0].frame
    west_m, north_m = grid.west_m - beyond * grid.gsd_m, grid.north_m + beyond * grid.gsd_m
    size = grid.width_px + 2 * beyond, grid.height_px + 2 * beyond
    sheet = Mosaic.open([present]).sheet(
        frame, west_m=west_m, north_m=north_m, width_px=size[0], height_px=size[1], gsd_m=grid.gsd_m
    )
    with sheet as raster:
        grey = raster.read_grey(0, 0, *size).grey
    return opened, Raster(grey.astype(np.float32), west_m, north_m, grid.gsd_m)


def _hills(row: Row, grey: Raster, seed: int) -> Raster:
    rows, cols = grey.values.shape
    fine_m = POSTING_M / FINER
    size = math.ceil(rows * grey.pixel_m / fine_m), math.ceil(cols * grey.pixel_m / fine_m)
    made = random_relief(size, fine_m, row.slope, row.shortest_m, seed)
    return Raster(made + np.float32(BASE_M), grey.west_m, grey.north_m, fine_m)


def _seen(
    row: Row, opened: MapFile, ground: Raster, hills: Raster, rng: np.random.Generator
) -> tuple[View, Array, Array]:
    """A view, where its camera was (3,), and the ground that its middle shows (3,)."""
    grid = opened.manifest.sheets[0].grid
    side, oblique = row.view_px, row.agl_m is not None
    high = side * 3 // 4 if oblique else side
    camera = Camera(side, high, side / FIELD, side / FIELD, side / 2, high / 2)
    agl_m = row.agl_m or side * grid.gsd_m / FIELD
    extent = np.array([grid.width_px, -grid.height_px]) * grid.gsd_m
    corner = np.array([grid.west_m, grid.north_m])
    while True:
        place = corner + rng.uniform(0, 1, 2) * extent
        yaw, tilt = float(rng.uniform(0, 360)), rng.normal(0, TILT_STD_DEG, 2)
        attitude = yaw, row.tilt_deg + float(tilt[0]), float(tilt[1])
        position = np.array([*place, float(hills.at(place[:1], place[1:])[0]) + agl_m])
        axis = enu_from_camera(*attitude) @ [0.0, 0.0, 1.0]
        if axis[2] > -math.cos(math.radians(MAX_OFF_NADIR_DEG)):
            continue
        middle = position + axis * (agl_m / -axis[2])
        around = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * side * grid.gsd_m * 0.55
        if (abs((middle[:2] + around - corner) / extent - 0.5) <= 0.5).all():
            break
    grey, shown = seen_view(ground, hills, camera, attitude, position, 1 if row.tilt_deg else 2)
    blurred = cv2.GaussianBlur(grey, (0, 0), 0.6)
    noisy = blurred * rng.normal(1, 0.1) + rng.normal(0, 2, blurred.shape)
    measured_m = agl_m * (1 + float(rng.normal(0, AGL_STD))) if row.measured else math.nan
    rows, cols = hills.values.shape
    home_m = float(position[2] - hills.values[rows // 2, cols // 2])
    telemetry = Telemetry(
        0,
        (yaw + float(rng.normal(0, YAW_STD_DEG))) % 360,
        *attitude[1:],
        measured_m,
        yaw_std_deg=YAW_STD_DEG,
        agl_std_m=AGL_STD * agl_m if row.measured else None,
        home_m=None if row.measured else home_m,
        amsl_m=None if row.measured else float(position[2]),
    )
    picture = np.clip(noisy, 0, 255).astype(np.uint8)
    return View(picture, camera, telemetry), position, shown[high // 2, side // 2]


def _ways(row: Row, opened: MapFile, hills: Raster) -> Iterator[tuple[str, Locate]]:
    frame = opened.manifest.sheets[0].frame
    rows, cols = (side // FINER for side in hills.values.shape)
    coarse = cv2.resize(hills.values, (cols, rows), interpolation=cv2.INTER_AREA)
    layer = Raster(np.asarray(coarse, np.float32), hills.west_m, hills.north_m, POSTING_M)
    terrain = Terrain(frame, layer, row.wrong)
    lat, lon = frame.latlon_from_en(terrain.middle_en_m)
    level, over = Localizer(opened), Localizer(opened)
    assert over.registration is not None
    over.registration.ground = GroundModel(terrain, over.grid)  # heights as a layer's

    def on_level_ground(view: View) -> Fix | NoFix:
        telemetry = view.telemetry
        if telemetry.home_m is not None:
            telemetry = replace(telemetry, agl_m=telemetry.home_m)
        return level.locate(replace(view, telemetry=telemetry))

    def on_terrain(view: View) -> Fix | NoFix:
        above = map_heights(opened, terrain, take_off=(float(lat), float(lon), 0.0))
        assert above is not None
        return over.locate(replace(view, telemetry=above.corrected(view.telemetry)))

    yield "level", on_level_ground
    yield "terrain", on_terrain


def _placed(
    locate: Locate, frame: LocalFrame, view: View, position: Array, middle: Array
) -> list[float]:
    """Error of the camera (m), confidence, ms of the processor, and distance to the ground."""
    start = time.process_time()
    fix = locate(view)
    took_ms = 1e3 * (time.process_time() - start)
    range_m = float(np.linalg.norm(middle - position))
    if isinstance(fix, NoFix):
        return [math.inf, 0.0, took_ms, range_m]
    off = frame.en_from_latlon(fix.lat_deg, fix.lon_deg) - position[:2]
    return [float(np.hypot(*off)), fix.confidence, took_ms, range_m]


if __name__ == "__main__":
    sys.exit(run(measure, add))
