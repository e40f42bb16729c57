"""Views of relief, placed on level ground and on the terrain of the map.

`python -m benchmarks.over_terrain [--views 30] [--only GROUP ..] [--areas SEED ..] [--work DIR]`
drapes imagery of another date over generated hills, renders true perspective views of it
(`orthonav.ground.simulate.perspective`), and prints what of them is placed without and with the
terrain, by wrong terrains, and far off nadir. Imagery is generated; with optional real imagery
beside the checkout its rows use that. `--on`, `--off-nadir` and `--slopes` choose parts of the
rows.
`--mirrored` shows what views of no place of the map are taken for.
"""

import argparse
import hashlib
import logging
import math
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import rasterio
from lab.landscape import DEFAULT_DATES, generate_area
from numpy.typing import ArrayLike, NDArray
from rasterio.windows import Window

from benchmarks.inputs import DATA
from orthonav.cli.heights import map_heights
from orthonav.core.geo.camera import Camera, enu_from_camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.localize.ground import Relief
from orthonav.core.mapfile import MapFile, open_map
from orthonav.core.records import CONFIDENT, Fix, NoFix, Telemetry, View
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.simulate.perspective import Raster, random_relief, seen_view

GROUPS = ("slopes", "wrong", "oblique")
HEADER = (
    "views", "slope", "off nadir", "terrain", "right", "accepted of right", "confident and wrong",
    "median", "CPU",
)  # fmt: skip
POSTING_M = 10.0
"""That of a usual terrain layer; views are rendered over heights four times as fine."""
FINER = 4
YAW_STD_DEG, AGL_STD, TILT_STD_DEG = 5.0, 0.05, 3.0
"""Errors of heading and of a measured height; pitch and roll vary so far and are reported."""
FIELD = 0.96
"""Metres that a camera sees for each metre of height."""
BASE_M = 200.0
MAP_M, BEYOND_M = (2400, 2000), 1000
"""Size of the generated map, and how far the ground goes on around it."""
MAX_OFF_NADIR_DEG = 65.0
"""Views farther off nadir are refused, and not drawn."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One row: imagery, views and terrain.

    `tilt_deg`: angle off nadir, forwards. `measured`: whether the height above ground is measured
    (else heights above sea and take-off are). `wrong`: what is wrong with the terrain of the map.
    """

    group: str
    imagery: str
    view_px: int
    slope: float
    shortest_m: float
    measured: bool = False
    tilt_deg: float = 0.0
    wrong: str = ""
    agl_m: float | None = None
    radius_m: float = 15.0


class PlaneTerrain:
    """Heights of a raster in the plane of a sheet, as a terrain layer gives them."""

    def __init__(self, frame: LocalFrame, raster: Raster) -> None:
        self.frame, self.raster = frame, raster

    def at_en_m(self, points_en_m: ArrayLike) -> Array:
        """Heights (...) at points (..., 2); NaN outside and in holes."""
        points = np.asarray(points_en_m, np.float64)
        found = self.raster.at(points[..., 0], points[..., 1])
        return np.where(self.raster.holds(points), found, np.nan)

    def __call__(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """Heights (...) at positions (...)."""
        return self.at_en_m(self.frame.en_from_latlon(lat_deg, lon_deg))


@dataclass(frozen=True, eq=False)
class Ground:
    """A map, imagery of another date in its plane, and the extent of both."""

    opened: MapFile
    grey: Raster

    @property
    def gsd_m(self) -> float:
        """Ground resolution of the map."""
        return self.opened.manifest.sheets[0].grid.gsd_m

    def relief(self, row: Row, seed: int) -> Raster:
        """Hills under all of it."""
        rows, cols = self.grey.values.shape
        fine_m = POSTING_M / FINER
        size = tuple(math.ceil(side * self.grey.pixel_m / fine_m) for side in (rows, cols))
        made = random_relief((size[0], size[1]), fine_m, row.slope, row.shortest_m, seed)
        return Raster(made + np.float32(BASE_M), self.grey.west_m, self.grey.north_m, fine_m)


@dataclass(frozen=True, eq=False)
class Seen:
    """A view, where its camera was (3,), the ground that its middle shows (3,), and its true
    heading, pitch and roll."""

    view: View
    position_m: Array
    middle_m: Array
    attitude_deg: tuple[float, float, float]


class Bench:
    """Maps and imagery, made once."""

    def __init__(self, work: Path, views: int, seed: int, area: int = 3) -> None:
        """`seed`: of hills and views; `area`: of the generated imagery."""
        self.work, self.views, self.seed, self.area = work, views, seed, area
        self.ground = lru_cache(maxsize=1)(self._ground)

    def _ground(self, imagery: str) -> Ground:
        if imagery == "generated":
            past, present = self._generated()
        else:
            past, present = (DATA / name for name in imagery.split(","))
        path = self.work / f"{past.parent.name}-{past.stem}.onav"
        if not path.is_file():
            build_map(BuildRequest([past], path))
        opened = open_map(path)
        grid, frame = opened.manifest.sheets[0].grid, opened.manifest.sheets[0].frame
        beyond = round(BEYOND_M / grid.gsd_m) if imagery == "generated" else 0
        west_m, north_m = grid.west_m - beyond * grid.gsd_m, grid.north_m + beyond * grid.gsd_m
        width_px, height_px = grid.width_px + 2 * beyond, grid.height_px + 2 * beyond
        with Mosaic.open([present]).sheet(
            frame, west_m=west_m, north_m=north_m, width_px=width_px, height_px=height_px,
            gsd_m=grid.gsd_m,
        ) as raster:  # fmt: skip
            grey = raster.read_grey(0, 0, width_px, height_px).grey
        return Ground(opened, Raster(grey.astype(np.float32), west_m, north_m, grid.gsd_m))

    def _generated(self) -> tuple[Path, Path]:
        """Orthophotos of the map and of the flight, which reaches beyond the map: so does what
        cameras far off nadir see."""
        folder, dates = self.work / f"area-{self.area}", DEFAULT_DATES[:2]
        map_path, (past, present) = folder / "map.tif", (folder / f"{d.name}.tif" for d in dates)
        if not map_path.is_file():
            size_m = (MAP_M[0] + 2 * BEYOND_M, MAP_M[1] + 2 * BEYOND_M)
            generate_area(folder, size_m=size_m, dates=dates, seed=self.area)
            with rasterio.open(past) as data:
                part = Window(BEYOND_M, BEYOND_M, *MAP_M)
                profile = data.profile | {"width": MAP_M[0], "height": MAP_M[1]}
                profile["transform"] = data.window_transform(part)
                pixels = data.read(window=part)
            with rasterio.open(map_path, "w", **profile) as data:
                data.write(pixels)
        return map_path, present

    def seen(self, row: Row) -> tuple[list[Seen], Raster]:
        """The views of a row, and its hills."""
        ground = self.ground(row.imagery)
        hills = ground.relief(row, self.seed)
        key = hashlib.sha256(
            f"{replace(row, wrong='')}{self.views}{self.seed}{self.area}".encode()
        ).hexdigest()
        stored = self.work / f"{key[:16]}.views"
        if not stored.is_file():
            rng = np.random.default_rng(self.seed)
            made = [self._seen(row, ground, hills, rng) for _ in range(self.views)]
            stored.write_bytes(pickle.dumps(made))
        return pickle.loads(stored.read_bytes()), hills

    def _seen(self, row: Row, ground: Ground, hills: Raster, rng: np.random.Generator) -> Seen:
        side_m = row.view_px * ground.gsd_m
        camera, agl_m = camera_of(row, ground.gsd_m)
        grid = ground.opened.manifest.sheets[0].grid
        extent = np.array([grid.width_px, -grid.height_px]) * grid.gsd_m
        corner = np.array([grid.west_m, grid.north_m])
        while True:
            share = rng.uniform(0, 1, 2)
            place = corner + share * extent
            yaw = float(rng.uniform(0, 360))
            tilt = rng.normal(0, TILT_STD_DEG, 2)
            attitude = yaw, row.tilt_deg + float(tilt[0]), float(tilt[1])
            below = float(hills.at(place[:1], place[1:])[0])
            position = np.array([*place, below + agl_m])
            axis = enu_from_camera(*attitude) @ [0.0, 0.0, 1.0]
            if axis[2] > -math.cos(math.radians(MAX_OFF_NADIR_DEG)):
                continue
            middle = position + axis * (agl_m / -axis[2])
            near = middle[:2] + np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * side_m * 0.55
            if (abs((near - corner) / extent - 0.5) <= 0.5).all():
                break
        grey, seen = seen_view(
            ground.grey, hills, camera, attitude, position, 1 if row.tilt_deg else 2
        )
        blurred = cv2.GaussianBlur(grey, (0, 0), 0.6)
        noisy = blurred * rng.normal(1, 0.1) + rng.normal(0, 2, blurred.shape)
        measured_m = agl_m * (1 + float(rng.normal(0, AGL_STD))) if row.measured else math.nan
        telemetry = Telemetry(
            time_ns=0,
            yaw_deg=(yaw + float(rng.normal(0, YAW_STD_DEG))) % 360,
            pitch_deg=attitude[1],
            roll_deg=attitude[2],
            agl_m=measured_m,
            yaw_std_deg=YAW_STD_DEG,
            agl_std_m=AGL_STD * agl_m if row.measured else None,
            home_m=None if row.measured else float(position[2] - home_m(hills)),
            amsl_m=None if row.measured else float(position[2]),
        )
        picture = np.clip(noisy, 0, 255).astype(np.uint8)
        middle_ground = seen[seen.shape[0] // 2, seen.shape[1] // 2]
        return Seen(View(picture, camera, telemetry), position, middle_ground, attitude)


def camera_of(row: Row, gsd_m: float) -> tuple[Camera, float]:
    """The camera of a row and its height above ground."""
    side = row.view_px
    if row.agl_m is not None:
        focal = side / FIELD
        return Camera(side, side * 3 // 4, focal, focal, side / 2, side * 3 / 8), row.agl_m
    focal = side / FIELD
    return Camera(side, side, focal, focal, side / 2, side / 2), side * gsd_m / FIELD


def home_m(hills: Raster) -> float:
    """Height of the ground at the take-off: the middle."""
    rows, cols = hills.values.shape
    return float(hills.values[rows // 2, cols // 2])


def layer_of(row: Row, ground: Ground, hills: Raster) -> PlaneTerrain:
    """The terrain of the map, with what is wrong with it."""
    rows, cols = (side // FINER for side in hills.values.shape)
    coarse = cv2.resize(hills.values, (cols, rows), interpolation=cv2.INTER_AREA)
    values, shift_m = np.asarray(coarse, np.float32), 0.0
    if row.wrong == "displaced by 200 m":
        shift_m = 200.0
    elif row.wrong == "50 m too high":
        values = values + np.float32(50)
    elif row.wrong == "with holes":
        values = values.copy()
        for number in range(8):
            top, left = np.random.default_rng([7, number]).integers(0, [rows - 20, cols - 20])
            values[top : top + 40, left : left + 40] = np.nan
    frame = ground.opened.manifest.sheets[0].frame
    return PlaneTerrain(frame, Raster(values, hills.west_m + shift_m, hills.north_m, POSTING_M))


@dataclass(frozen=True, eq=False)
class Placed:
    """What a way of placing made of the views: errors of the camera (m), of its height as a share,
    confidences, milliseconds of the processor, and `terrain_gain`."""

    errors_m: Array
    confidences: Array
    heights: Array
    took_ms: Array
    gains: Array
    ranges_m: Array

    def cells(self, row: Row) -> str:
        """Cells of a table."""
        limit = np.maximum(row.radius_m, 0.03 * self.ranges_m if row.tilt_deg else 0.0)
        right = self.errors_m <= limit
        confident = self.confidences >= CONFIDENT
        accepted = (confident & right).sum() / max(right.sum(), 1)
        wrong = int((confident & ~right).sum())
        median = float(np.median(self.errors_m[right])) if right.any() else math.nan
        return (
            f"{right.mean():.0%} | {accepted:.0%} | {wrong} | {median:.1f} m | "
            f"{np.median(self.took_ms):.0f} ms"
        )


def placed(
    locate: Callable[[View], Fix | NoFix], seen: list[Seen], frame: LocalFrame, *, mirrored: bool
) -> Placed:
    """Place views one by one, as they are or mirrored: then they are nowhere on the map."""
    rows = []
    for each in seen:
        view = each.view
        if mirrored:
            view = replace(view, grey=np.ascontiguousarray(view.grey[:, ::-1]))
        start = time.process_time()
        fix = locate(view)
        took_ms = 1e3 * (time.process_time() - start)
        range_m = float(np.linalg.norm(each.middle_m - each.position_m))
        if isinstance(fix, NoFix):
            logging.info("%s: %s", fix.reason, fix.detail)
            rows.append([math.inf, 0.0, math.nan, took_ms, math.nan, range_m])
            continue
        error_m = np.hypot(*(frame.en_from_latlon(fix.lat_deg, fix.lon_deg) - each.position_m[:2]))
        gain = fix.evidence.get("terrain_gain", math.nan)
        logging.info("%.1f m, confidence %.2f, gain %.2f", error_m, fix.confidence, gain)
        rows.append([error_m, fix.confidence, fix.agl_m, took_ms, gain, range_m])
    return Placed(*np.array(rows, np.float64).T)


def ways(
    ground: Ground, terrain: PlaneTerrain, hills: Raster
) -> Iterator[tuple[str, Callable[[View], Fix | NoFix]]]:
    """Level ground and terrain."""
    middle = ground.grey.west_m, ground.grey.north_m
    rows, cols = ground.grey.values.shape
    middle_m = np.array([middle[0] + cols * ground.gsd_m / 2, middle[1] - rows * ground.gsd_m / 2])
    lat, lon = ground.opened.manifest.sheets[0].frame.latlon_from_en(middle_m)
    level = Localizer(ground.opened)

    def on_level_ground(view: View) -> Fix | NoFix:
        telemetry = view.telemetry
        if telemetry.home_m is not None:
            telemetry = replace(telemetry, agl_m=telemetry.home_m)
        return level.locate(replace(view, telemetry=telemetry))

    yield "level", on_level_ground
    over = Localizer(ground.opened)
    assert over.registration is not None
    # It gives heights as a terrain layer does.
    over.registration.relief = Relief(terrain, over.grid)

    def on_terrain(view: View) -> Fix | NoFix:
        heights = map_heights(ground.opened, terrain, take_off=(float(lat), float(lon), 0.0))
        assert heights is not None
        return over.locate(replace(view, telemetry=heights.corrected(view.telemetry)))

    yield "terrain", on_terrain


def rows_of(options: argparse.Namespace) -> Iterator[Row]:
    """The rows that are wanted and possible."""
    real = (DATA / "airchange/szada_1_a.tif").is_file() and not options.generated
    fine = "airchange/szada_1_a.tif,airchange/szada_1_b.tif" if real else "generated"
    naip = (DATA / "naip_nd/20090818.tif").is_file() and not options.generated
    for slope in (0.0, 0.2, 0.3):
        yield Row("slopes", fine, 256, slope, 300.0, measured=True)
    for slope in (0.0, 0.2, 0.3):
        yield Row("slopes", fine, 128, slope, 300.0)
    if naip:
        coarse = "naip_nd/20090818.tif,naip_nd/20180716.tif"
        for slope in (0.0, 0.2, 0.3):
            yield Row("slopes", coarse, 256, slope, 600.0)
    for wrong in ("", "displaced by 200 m", "50 m too high", "with holes"):
        yield Row("wrong", fine, 192, 0.2, 300.0, wrong=wrong)
    for tilt in options.off_nadir:
        for slope in options.slopes:
            yield Row(
                "oblique", "generated", 480, slope, 300.0, tilt_deg=tilt, agl_m=250.0, radius_m=25.0
            )


def main() -> None:
    """Place, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, help="folder that is kept (default: a temporary one)")
    parser.add_argument("--views", type=int, default=30, help="views of a row and area")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=GROUPS)
    parser.add_argument(
        "--areas", type=int, nargs="+", default=[3], help="seeds of the generated imagery"
    )
    parser.add_argument(
        "--on", nargs="+", choices=("level", "terrain"), default=("level", "terrain"),
        help="what views are placed on",
    )  # fmt: skip
    parser.add_argument(
        "--off-nadir", type=float, nargs="+", default=[0.0, 30.0, 45.0, 60.0],
        help="of the oblique views, degrees",
    )  # fmt: skip
    parser.add_argument(
        "--slopes", type=float, nargs="+", default=[0.0, 0.15], help="of the oblique views"
    )
    parser.add_argument("--generated", action="store_true", help="generated imagery only")
    parser.add_argument(
        "--mirrored", action="store_true", help="mirror the views: all positions are wrong then"
    )
    parser.add_argument("--verbose", action="store_true", help="log every view")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO if options.verbose else logging.ERROR)
    cv2.setNumThreads(1)
    print("| " + " | ".join(HEADER) + " |")
    print("|---|--:|--:|---|--:|--:|--:|--:|--:|")
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        benches = [Bench(work, options.views, options.seed, area) for area in options.areas]
        for row in rows_of(options):
            if row.group in options.only:
                _print(benches, row, options.on, mirrored=options.mirrored)


def _print(benches: list[Bench], row: Row, on: Sequence[str], *, mirrored: bool) -> None:
    """The lines of a row, of the views over all areas together; real imagery is one area."""
    found: dict[str, list[Placed]] = {}
    for bench in benches if row.imagery == "generated" else benches[:1]:
        ground = bench.ground(row.imagery)
        seen, hills = bench.seen(row)
        frame = ground.opened.manifest.sheets[0].frame
        for way, locate in ways(ground, layer_of(row, ground, hills), hills):
            if way in on and not (way == "level" and row.wrong):
                made = placed(locate, seen, frame, mirrored=mirrored)
                found.setdefault(way, []).append(made)
        bench.ground.cache_clear()
    height = "measured" if row.measured else "above sea"
    for way, parts in found.items():
        whole = Placed(*(np.concatenate(each) for each in zip(*map(astuple, parts), strict=True)))
        name = f"{len(whole.errors_m)} of {ground.gsd_m:.3g} m, {row.view_px} px, height {height}"
        shown = f"{way} {row.wrong}".strip() + (", mirrored" if mirrored else "")
        cells = whole.cells(row)
        print(f"| {name} | {row.slope:g} | {row.tilt_deg:.0f} | {shown} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
