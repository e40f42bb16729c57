"""A flight over hills, tracked end to end: simulated over a surface model, placed on a terrain.

`python -m benchmarks.terrain_flight [--work DIR] [--pitch-deg 0 30]` generates an area with hills,
builds a map of one date with its terrain, flies a route over the surface model of another date, in
which houses and trees stand up, and follows it. The barometer is off. With a camera that looks down
terrains are right or wrong, with one that looks ahead right.
"""

import argparse
import logging
import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from lab.landscape import DEFAULT_DATES, generate_area, generate_heights
from numpy.typing import ArrayLike, NDArray

from orthonav.cli.heights import map_heights
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer
from orthonav.core.localize.ground import Relief
from orthonav.core.mapfile import MapFile, open_map
from orthonav.core.mapfile.terrain import TerrainLayer
from orthonav.core.records import CONFIDENT, Fix
from orthonav.core.track.tracker import Tracker
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.imagery.terrain import Dem, open_dem
from orthonav.ground.planning.route import Route
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import Locator, SingleViews, localize_flight

SLOPE, AGL_M, SPACING_M = 0.15, 200.0, 40.0
CAMERA = Camera(640, 480, 560.0, 560.0, 320.0, 240.0)
TURNS = ((0.2, 0.2), (0.8, 0.3), (0.3, 0.6), (0.75, 0.8))
"""A route by shares of the area's sides."""
BARO_SHARE = 0.08
"""Error of the reported heights, as a share of that above ground: 16 m."""
RIGHT_M = 15.0
SHIFT_M, RAISE_M, HOLES = 200.0, 50.0, 30
WRONG = ("", "displaced by 200 m", "50 m too high", "with holes")
HEADER = (
    "camera", "terrain", "method", "within 15 m", "confident", "confident and wrong", "median",
    "p95", "height bias", "named",
)  # fmt: skip
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WrongTerrain:
    """The terrain of a map with something wrong."""

    layer: TerrainLayer
    wrong: str

    def at_en_m(self, points_en_m: ArrayLike) -> Array:
        """Heights (...) at points (..., 2)."""
        points = np.asarray(points_en_m, np.float64)
        if self.wrong.startswith("displaced"):
            points = points - [SHIFT_M, 0.0]
        heights = self.layer.at_en_m(points)
        if self.wrong.startswith("50 m"):
            return np.asarray(heights + RAISE_M)
        if self.wrong == "with holes":
            middles = np.random.default_rng(7).uniform(-1300, 1300, (HOLES, 2))
            for middle in middles:
                near = np.abs(points - middle).max(axis=-1) < 100
                heights = np.where(near, np.nan, heights)
        return heights

    def __call__(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """Heights (...) at positions (...)."""
        return self.at_en_m(self.layer.frame.en_from_latlon(lat_deg, lon_deg))


class Named(logging.Handler):
    """Counts warnings of the terrain."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Take a line."""
        if "terrain" in record.getMessage():
            self.lines.append(record.getMessage())


def made(work: Path, side_m: float, pitch_deg: float) -> tuple[Path, Path]:
    """Map and flight folder."""
    size_m, dates = (side_m, side_m), DEFAULT_DATES[:2]
    past, present = (work / f"{date.name}.tif" for date in dates)
    map_path, folder = work / "area.onav", work / f"flight-{pitch_deg:.0f}"
    if not map_path.is_file():
        generate_area(work, size_m=size_m, dates=dates, seed=5)
        generate_heights(work, slope=SLOPE, size_m=size_m, dates=dates[1:], seed=5)
        build_map(BuildRequest([past], map_path, dem=work / "dem.tif"))
    if not folder.is_dir():
        surface: Dem = open_dem(work / f"{dates[1].name}_dsm.tif", None)
        sheet = open_map(map_path).manifest.sheets[0]
        lat, lon = sheet.frame.latlon_from_en((np.array(TURNS) - 0.5) * side_m)
        simulate_flight(
            SimulateRequest(
                [present], folder, route=Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True))),
                agl_m=AGL_M, spacing_m=SPACING_M, camera=CAMERA, terrain=surface,
                terrain_posting_m=surface.gsd_m, camera_pitch_deg=pitch_deg, turn_radius_m=60.0,
                errors=Errors(yaw_std_deg=3.0, agl_bias=BARO_SHARE, attitude_std_deg=2.0), seed=3,
            )
        )  # fmt: skip
    return map_path, folder


def rows(opened: MapFile, folder: Path, wrong: str) -> Iterator[tuple[str, ...]]:
    """A row for single views and one for the track."""
    flight, truth = open_flight(folder), read_truth(folder / "truth.csv")
    layer = TerrainLayer.of(opened)
    assert layer is not None
    terrain = WrongTerrain(layer, wrong)
    for method in ("one by one", "tracked"):
        localizer = Localizer(opened)
        assert localizer.registration is not None
        # It gives heights as a terrain layer does.
        localizer.registration.relief = Relief(terrain, localizer.grid)
        locator: Locator = SingleViews(localizer)
        if method == "tracked":
            locator = Tracker(localizer)
        named, log = Named(), logging.getLogger("orthonav")
        log.addHandler(named)
        log.setLevel(min(log.getEffectiveLevel(), logging.WARNING))
        results = list(localize_flight(locator, flight, heights=map_heights(opened, terrain)))
        log.removeHandler(named)
        errors, confident, biases = [], [], [math.nan]
        for result in results:
            fix, off_m, is_confident = result.outcome, math.inf, False
            if isinstance(fix, Fix):
                frame = localizer.sheet.frame
                there = frame.en_from_latlon(*truth[result.frame])
                here = frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
                off_m, is_confident = float(np.hypot(*(there - here))), fix.confidence >= CONFIDENT
                biases.append(fix.evidence.get("log_scale_bias", math.nan))
            errors.append(off_m)
            confident.append(is_confident)
            logging.info("%s %.1f %s", result.frame, errors[-1], fix)
        off, accepted = np.array(errors), np.array(confident)
        right = off <= RIGHT_M
        yield (
            method, f"{right.mean():.0%}", f"{accepted.mean():.0%}",
            f"{int((accepted & (off > 35)).sum())}", f"{np.median(off):.1f} m",
            f"{np.percentile(off[np.isfinite(off)], 95):.1f} m",
            f"{biases[-1]:+.3f}", "; ".join(named.lines) or "no",
        )  # fmt: skip


def main() -> None:
    """Fly, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, help="folder that is kept (default: a temporary one)")
    parser.add_argument("--side-m", type=float, default=2600.0, help="side of the area")
    parser.add_argument("--pitch-deg", type=float, nargs="+", default=[0.0, 30.0])
    parser.add_argument("--verbose", action="store_true", help="log every view")
    options = parser.parse_args()
    logging.basicConfig(level=logging.DEBUG if options.verbose else logging.ERROR)
    cv2.setNumThreads(1)
    print("| " + " | ".join(HEADER) + " |\n|---|---|---|" + 6 * "--:|" + "---|")
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        for pitch_deg in options.pitch_deg:
            map_path, folder = made(work, options.side_m, pitch_deg)
            for wrong in WRONG if pitch_deg == 0 else WRONG[:1]:
                for cells in rows(open_map(map_path), folder, wrong):
                    shown = (f"{pitch_deg:.0f} deg off nadir", wrong or "right", *cells)
                    print("| " + " | ".join(shown) + " |", flush=True)


if __name__ == "__main__":
    main()
