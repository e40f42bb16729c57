"""Where the views of a row come from: rendered over relief, of flat ground, or recorded."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from lab.terrain import seen_view
from numpy.typing import NDArray

from benchmarks.closed_loop.replays import OFF, ON, Area, Recorded, stated
from benchmarks.judged_views import is_covered
from benchmarks.real_ground.maps import BARE, SURFACE, found, landscape_heights, relief_file
from benchmarks.real_ground.score import Seen, Source
from benchmarks.scenes import DATA, Pair, flight, root_agl_of, views_in
from orthonav.cli.source import map_heights
from orthonav.core.files import replacing
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.camera import FOV_STD, Camera, axis_on_ground_en_m
from orthonav.core.localize import Localizer
from orthonav.core.records import Telemetry, View
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.simulate.flight import DEFAULT_CAMERA, Errors
from orthonav.ground.simulate.render import Raster, ViewEffects, degraded

SEED, WIDTH_PX = 1, 256
YAW_STD_DEG, AGL_STD = 10.0, 0.1
"""Errors of heading and height, which are reported."""
MIDDLE_STD, BARREL = 0.01, 0.05
"""Errors of a nominal lens beside that of its focal length (`FOV_STD`): standard deviation of the
principal point as a share of the width, and the largest k1."""
CAMERA, EFFECTS = DEFAULT_CAMERA.fitted(640, 480), ViewEffects()
RIM_PX = 50.0  # of the map, over which no camera is: heights end there
LEAD = 50  # views with GNSS before a track is judged
Array = NDArray[np.float64]


@dataclass(frozen=True)
class OverRelief(Source):
    """Views rendered over relief, or over the surface of generated ground; heights count from bare
    ground.

    - `pair`: imagery of the map and of the views. `slope`: of the relief, per cent.
    - `tilt_std_deg`: of the true pitch and roll, reported as 0; `stated_deg`: the deviation that is
      reported with them.
    - `nominal`: whether the lens is known by its field of view only.
    - `agl_m`: height; None: that from which a view is `WIDTH_PX` of the map across. `ahead_deg`:
      how far the camera looks ahead. `within_m`: ground in the middle of the view lies so far from
      the middle of the map at most.
    - `draped`: generated imagery is draped over hills, as other imagery is.
    - `above_sea`: the height above sea is reported, and not that above ground.
    """

    pair: Pair
    slope: float
    tilt_std_deg: float = 0.0
    stated_deg: float | None = None
    nominal: bool = False
    agl_m: float | None = None
    ahead_deg: float = 0.0
    within_m: float = math.inf
    draped: bool = False
    above_sea: bool = False

    def imagery(self) -> str:
        return self.pair.views

    def pictures(self) -> str:
        lens = "-nominal" if self.nominal else ""
        if self.agl_m is not None:
            lens += f"-{self.agl_m:g}m-{self.ahead_deg:g}deg-within-{self.within_m:g}m"
        name = self.pair.name.replace(" ", "").replace(">", "-")
        return f"{name}-{self.slope:g}-{self.tilt_std_deg:g}{lens}"

    def seen(self, work: Path, base: Localizer, views: int, tracked: bool) -> Iterator[Seen]:
        folder = work / f"pictures-{self.pictures()}"
        folder.mkdir(parents=True, exist_ok=True)
        imagery, inside_m = self._imagery(work, base)
        relief: Raster | None = None
        ground = open_dem(self._heights(work, BARE))
        flown = map_heights(base.opened) if self.above_sea else None
        for number in range(views):
            rng = np.random.default_rng([SEED, number])
            true, place = self._pose(base, inside_m, rng)
            lens, camera = self._lens(rng)
            lat, lon = base.sheet.frame.latlon_from_en(place)
            path = folder / f"{number:04d}.png"
            if not path.is_file():
                relief = relief or self._relief(work, base)
                above = float(ground(lat[None], lon[None])[0]) + true.agl_m
                attitude = true.yaw_deg, true.pitch_deg, true.roll_deg
                position = np.array([*place, above])
                grey, _ = seen_view(imagery, relief, lens, attitude, position, 1)
                seen = degraded(np.repeat(grey[..., None], 3, -1), EFFECTS, rng)
                with replacing(path) as part:
                    cv2.imwrite(str(part), seen[..., 0])
            grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
            rng = np.random.default_rng([SEED, number, 1])
            reported = level_telemetry(true, rng, self.stated_deg, self.ahead_deg)
            if flown is not None:
                amsl_m = float(ground(lat[None], lon[None])[0]) + true.agl_m
                unknown = replace(reported, agl_m=math.nan, agl_std_m=None, amsl_m=amsl_m)
                reported = flown.corrected(unknown)
            yield Seen(View(grey, camera, reported), (float(lat), float(lon)), true.agl_m)

    def _heights(self, work: Path, kind: str) -> Path:
        if self.pair.views.startswith("generated:") and not self.draped:
            return landscape_heights(self.pair.views, work, self.slope, kind)
        return relief_file(self.pair.map, work, self.slope, BARE)

    def _imagery(self, work: Path, base: Localizer) -> tuple[Raster, Array]:
        """The later date in the plane of the map, and metres (H, W) to where it shows nothing."""
        grid, frame = base.grid, base.sheet.frame
        size = grid.width_px, grid.height_px
        sheet = Mosaic.open([found(self.pair.views, work)]).sheet(
            frame, west_m=grid.west_m, north_m=grid.north_m, width_px=size[0], height_px=size[1],
            gsd_m=grid.gsd_m,
        )  # fmt: skip
        with sheet as raster:
            read = raster.read_grey(0, 0, *size)
        inside = np.pad(read.valid, 1).astype(np.uint8)
        distance_m = cv2.distanceTransform(inside, cv2.DIST_L2, 5)[1:-1, 1:-1] * grid.gsd_m
        grey = read.grey.astype(np.float32)
        return Raster(grey, grid.west_m, grid.north_m, grid.gsd_m), np.asarray(distance_m)

    def _relief(self, work: Path, base: Localizer) -> Raster:
        """The heights in the plane of the map."""
        grid = base.grid
        posting_m = min(2.0, grid.gsd_m)
        cols, rows = (
            math.ceil(side * grid.gsd_m / posting_m) for side in (grid.width_px, grid.height_px)
        )
        dem = open_dem(self._heights(work, SURFACE))
        made = dem.in_plane(base.sheet.frame, grid.west_m, grid.north_m, posting_m, rows, cols)
        made = np.where(np.isfinite(made), made, np.nanmean(made))  # a rim that no view shows
        return Raster(made.astype(np.float32), grid.west_m, grid.north_m, posting_m)

    def _pose(
        self, base: Localizer, inside_m: Array, rng: np.random.Generator
    ) -> tuple[Telemetry, Array]:
        """A true pose over the map, and its place (2,): the middle of the view shows imagery, and a
        view straight down from above it would show nothing else."""
        assert base.registration is not None
        grid = base.grid
        agl_m = self.agl_m or root_agl_of(WIDTH_PX, grid.gsd_m)
        reach_m = math.hypot(*CAMERA.extent) / 2 * agl_m
        rows, cols = inside_m.shape
        while True:
            share = rng.uniform(0, 1, 2)
            at = np.array([share[0] * cols, -share[1] * rows]) * grid.gsd_m
            middle = np.array([grid.west_m, grid.north_m]) + at
            yaw, (pitch, roll) = float(rng.uniform(0, 360)), rng.normal(0, 1, 2).tolist()
            lat, lon = (float(v) for v in base.sheet.frame.latlon_from_en(middle))
            seen = inside_m[int(share[1] * rows), int(share[0] * cols)] >= reach_m
            seen &= math.hypot(*((share - 0.5) * [cols, rows])) * grid.gsd_m <= self.within_m
            place = middle - axis_on_ground_en_m(yaw, self.ahead_deg, 0.0, agl_m)
            col, row = (place - [grid.west_m, grid.north_m]) / [grid.gsd_m, -grid.gsd_m]
            seen &= RIM_PX < col < cols - RIM_PX and RIM_PX < row < rows - RIM_PX
            if seen and is_covered(base.registration, (lat, lon), WIDTH_PX):
                pitch, roll = self.ahead_deg + pitch * self.tilt_std_deg, roll * self.tilt_std_deg
                return Telemetry(0, yaw, pitch, roll, agl_m), place

    def _lens(self, rng: np.random.Generator) -> tuple[Camera, Camera]:
        """The lens of a view, and as the localizer knows it."""
        nominal = CAMERA
        focal, east, south = rng.normal(0, [FOV_STD, MIDDLE_STD, MIDDLE_STD])
        barrel = float(rng.uniform(-BARREL, BARREL))
        if not self.nominal:
            return nominal, nominal
        lens = replace(
            nominal,
            fx_px=nominal.fx_px * (1 + focal),
            fy_px=nominal.fy_px * (1 + focal),
            cx_px=nominal.cx_px + east * nominal.width_px,
            cy_px=nominal.cy_px + south * nominal.width_px,
            distortion=(barrel, 0.0, 0.0, 0.0),
        )
        return lens, replace(nominal, focal_std=FOV_STD)


@dataclass(frozen=True)
class OverLevel(Source):
    """Views of flat ground, true and reported tilt as of `OverRelief`."""

    pair: Pair
    tilt_std_deg: float
    stated_deg: float | None = None
    std_m: float = 0.0

    def imagery(self) -> str:
        return self.pair.views

    def pictures(self) -> str:
        return f"level-{self.pair.name}-{self.tilt_std_deg:g}"

    def seen(self, work: Path, base: Localizer, views: int, tracked: bool) -> Iterator[Seen]:
        assert base.registration is not None
        path = found(self.pair.views, work)
        errors = Errors(attitude_std_deg=self.tilt_std_deg)
        agl_m = root_agl_of(WIDTH_PX, base.grid.gsd_m)
        folder = flight(path, work, views=views, errors=errors, seed=SEED, agl_m=agl_m)
        for number, each in enumerate(views_in(folder)):
            place, true = each.truth_latlon_deg, each.view.telemetry
            if is_covered(base.registration, place, WIDTH_PX):
                rng = np.random.default_rng([SEED, number])
                reported = level_telemetry(true, rng, self.stated_deg)
                yield Seen(replace(each.view, telemetry=reported), place, true.agl_m)


def level_telemetry(
    true: Telemetry,
    rng: np.random.Generator,
    stated_deg: float | None = None,
    pitch_deg: float = 0.0,
) -> Telemetry:
    """Telemetry that reports a level camera, or one that looks ahead by `pitch_deg`, with errors of
    heading and height; `stated_deg`: the deviation of its tilt."""
    turn, log = rng.normal(0, 1, 2)
    return replace(
        true,
        yaw_deg=(true.yaw_deg + float(turn) * YAW_STD_DEG) % 360,
        pitch_deg=pitch_deg,
        roll_deg=0.0,
        agl_m=true.agl_m * max(0.5, 1 + float(log) * AGL_STD),
        yaw_std_deg=YAW_STD_DEG,
        agl_std_m=AGL_STD * true.agl_m,
        tilt_std_deg=stated_deg,
    )


@dataclass(frozen=True)
class Recording(Source):
    """A flight folder of real pictures. Single views are spread over it, a track takes `track`
    times as many.

    `truth`: file of the true positions, of the ground in the middle with `of_ground`. `only`: of
    these frames only.
    """

    folder: str
    std_m: float
    truth: str = "truth.csv"
    of_ground: bool = False
    only: str = ""
    track: int = 5

    def imagery(self) -> str:
        return self.folder

    def seen(self, work: Path, base: Localizer, views: int, tracked: bool) -> Iterator[Seen]:
        folder = DATA / self.folder
        flight, truth = open_flight(folder), read_truth(folder / self.truth)
        flown = [each for each in flight.views if each.frame in truth and self.only in each.frame]
        if tracked:
            flown = flown[: self.track * views]
        else:
            flown = flown[:: max(1, math.ceil(len(flown) / views))]
        for each in flown:
            view = View(each.grey(), flight.camera, each.telemetry)
            height_m = each.telemetry.agl_m
            yield Seen(view, truth[each.frame], height_m, of_ground=self.of_ground)


@dataclass(frozen=True)
class Replay(Source):
    """A recorded flight of an autopilot: a track begins with GNSS. `with_stds`: whether the
    telemetry states deviations. `phase`: what is judged; `OFF` ends before any disturbance."""

    folder: str
    with_stds: bool
    phase: str = OFF
    step: int = 5

    def imagery(self) -> str:
        return self.folder

    def pictures(self) -> str:
        return f"{self.folder}-{self.phase}"

    def seen(self, work: Path, base: Localizer, views: int, tracked: bool) -> Iterator[Seen]:
        recorded, area = Recorded(DATA / self.folder), Area.demo(work)
        area.__dict__["localizer"] = base  # the same area; its own map would be built once more
        autopilot = recorded.folder.name.partition("_")[0]
        aided = [each.number for each in recorded.exposures if each.phase == ON]
        judged = [each.number for each in recorded.exposures if each.phase == self.phase]
        judged = judged[: self.step * views : 1 if tracked else self.step]
        led = {*judged, *(aided[-LEAD:] if tracked else ())}
        if self.phase != OFF:  # all that the track has seen before
            led = set(range(aided[-LEAD], judged[-1] + 1))
        for exposure, telemetry in recorded.stated():
            if exposure.number not in led or telemetry.missing():
                continue
            if self.with_stds:
                telemetry = stated(autopilot, telemetry, exposure.phase == ON)
            view = recorded.view(area, work / "views", exposure, telemetry)
            place = exposure.lat_deg, exposure.lon_deg
            yield Seen(view, place, exposure.agl_m, judged=exposure.phase == self.phase)
