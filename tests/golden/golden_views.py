"""The golden views: 200 single views over five maps and two tracks, made from the demo's imagery.

Each map shows a part of one orthophoto; the flights are simulated over the same part of the other,
with realistic errors of heading, height, mount and horizon.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import rasterio
from lab.clouds import Clouds
from rasterio.transform import Affine
from rasterio.windows import Window
from threadpoolctl import threadpool_info

from orthonav.cli.demo import IMAGERY
from orthonav.cli.source import map_heights
from orthonav.core.flight import open_flight
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, NoFix, ViewResult
from orthonav.core.track.tracker import Tracker
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.imagery.terrain import DATUM_TAG, open_dem
from orthonav.ground.planning.route import Route
from orthonav.ground.recordings.localize import localize_flight
from orthonav.ground.simulate.flight import Errors, SimulateRequest, simulate_flight
from orthonav.onboard.run import SingleViews

FILE = Path(__file__).parent / "golden_views.json"
OLDER, NEWER = "2016-07.tif", "2021-10.tif"
CAMERA = Camera(480, 360, 375.0, 375.0, 240.0, 180.0)
"""Views cover 346 x 259 m from 270 m."""
POSTING_M = 10.0
"""Distance of the heights of the terrain."""
UNREPORTED = {"mount_std_deg": 1.0, "horizon_std_deg": 1.0}
"""Usual tilt of mount and horizon that the telemetry does not report."""
ZIGZAG = ((-0.6, -0.6), (-0.5, 0.6), (0.0, 0.5), (0.2, -0.5), (0.6, 0.6))
"""Waypoints of the tracks, east and north from the centre, in halves of the side of the map."""
DIGITS = 4
SHOWN = 12
"""Differences that a message lists."""
TOLERANCES = {
    "east_m": 0.01,
    "north_m": 0.01,
    "heading_deg": 0.01,
    "confidence": 0.01,
    "std_m": 0.01,  # a share
}
"""With the instructions and kernels that made the file."""
ON_OTHER_PROCESSORS = {
    "east_m": 0.5,
    "north_m": 0.5,
    "heading_deg": 0.1,
    "confidence": 0.03,
    "std_m": 0.08,
}
"""Others round differently. Between AVX-512, AVX2 and SSE, confident single
views move by up to 0.4 m over terrain, a sixth of their standard deviation, tracks by 0.1 m,
confidences by 0.02, standard deviations by 6 %."""
FLAT_CONFIDENCE, FLAT_TIMES = 0.5, 5.0
"""On these, fixes below this confidence may differ so much more: the score around them is nearly
level, and rounding decides where its refinement ends (by up to 2.2 m)."""
CPU_AVX2, CPU_AVX512_SKX = 11, 256
"""Numbers of OpenCV's `CpuFeatures`."""
Row = dict[str, float | str]
"""The result of a view: `reason` of a `NoFix`, or the numbers of a fix (see `row_of`)."""


@dataclass(frozen=True)
class Area:
    """A map of a part of an orthophoto, and what is flown over.

    - `corner_px`, `side_px`: the part, pixels of 1 m. `mapped`, `flown`: the orthophotos.
    - `build`: fields of `BuildRequest`.
    - `hills_m`: amplitude of the terrain, in the map and below the flight; None: none.
    """

    corner_px: tuple[int, int]
    side_px: int
    build: Mapping[str, Any]
    mapped: str = OLDER
    flown: str = NEWER
    hills_m: float | None = None


@dataclass(frozen=True)
class Flight:
    """A simulated flight over an area, and how its views are located.

    - `area`: name of the area. `seed`: of the flight.
    - `flown`: fields of `SimulateRequest`; without `random` along `ZIGZAG`.
    - `errors`: fields of `Errors`, besides those of mount and horizon.
    """

    area: str
    seed: int
    flown: Mapping[str, Any]
    errors: Mapping[str, Any]
    registration: bool = True
    heading_known: bool = True
    track: bool = False


AREAS = {
    "usual": Area((0, 0), 1200, {"tile_px": 256}),
    "narrow": Area((700, 0), 1200, {"tile_px": 128}),
    "terrain": Area((0, 800), 1100, {"tile_px": 256}, hills_m=40.0),
    "newer": Area((700, 700), 1300, {"tile_px": 128, "gsd_m": 2.0}, mapped=NEWER, flown=OLDER),
    "paper": Area((300, 300), 1200, {"tile_px": 256, "edges": "canny", "registration": False}),
}
FLIGHTS = {
    "usual": Flight(
        "usual", 1, {"random": 50, "agl_m": 270.0}, {"yaw_std_deg": 5.0, "agl_std": 0.05}
    ),
    "narrow views, clouds": Flight(
        "narrow",
        2,
        {"random": 50, "agl_m": 135.0, "clouds": partial(Clouds, 0.2)},
        {"yaw_std_deg": 5.0, "agl_std": 0.05},
    ),
    "terrain, with prior": Flight(
        "terrain", 3, {"random": 25, "agl_m": 270.0}, {"yaw_std_deg": 5.0, "prior_std_m": 60.0}
    ),
    "unknown heading, poor height": Flight(
        "newer", 4, {"random": 30, "agl_m": 300.0}, {"agl_std": 0.15}, heading_known=False
    ),
    "embedding only": Flight(
        "paper",
        5,
        {"random": 45, "agl_m": 270.0},
        {"yaw_std_deg": 2.0, "agl_std": 0.02},
        registration=False,
    ),
    "track, clouds": Flight(
        "usual",
        6,
        {"spacing_m": 60.0, "agl_m": 270.0, "turn_radius_m": 60.0, "clouds": partial(Clouds, 0.3)},
        {"yaw_std_deg": 5.0, "agl_std": 0.05, "velocity_drift": 0.05},
        track=True,
    ),
    "track, unknown heading, camera odometry": Flight(
        "newer",
        7,
        {"spacing_m": 60.0, "agl_m": 300.0, "turn_radius_m": 60.0},
        {"agl_std": 0.1},
        heading_known=False,
        track=True,
    ),
}


def located(name: str, folder: Path) -> list[Row]:
    """Results of the views of a flight; map and flight are written to a folder, both once."""
    prepare(name, folder)
    return locate(name, folder)


def prepare(name: str, folder: Path) -> None:
    """Write the map and the flight of a flight to a folder, both once."""
    flight = FLIGHTS[name]
    place = folder / flight.area
    if not place.exists():
        _build(AREAS[flight.area], place)
    if not (place / f"flight{flight.seed}").exists():
        _simulate(flight, place)


def locate(name: str, folder: Path) -> list[Row]:
    """Rows of the views of a flight that is prepared in a folder."""
    results, frame = results_of(name, folder)
    return [row_of(result, frame) for result in results]


def results_of(name: str, folder: Path) -> tuple[list[ViewResult], LocalFrame]:
    """Results of the views of such a flight, and the frame of its map."""
    flight = FLIGHTS[name]
    place = folder / flight.area
    opened = open_map(place / "map.onav")
    localizer = Localizer(opened, registration=flight.registration)
    locator = (Tracker if flight.track else SingleViews)(
        localizer, heading_known=flight.heading_known
    )
    flown = open_flight(place / f"flight{flight.seed}")
    results = localize_flight(locator, flown, heights=map_heights(opened))
    return list(results), opened.manifest.sheets[0].frame


def _build(area: Area, folder: Path) -> None:
    """Write the imagery, the terrain and the map of an area."""
    folder.mkdir()
    mapped = _cut(area, area.mapped, folder / "mapped.tif")
    _cut(area, area.flown, folder / "flown.tif")
    dem = None
    if area.hills_m is not None:
        dem = _write_hills(mapped, folder / "dem.tif", area.hills_m)
    usual = {"overlap": 0.75, "calibration_views": 8, "workers": 1}
    build_map(BuildRequest([mapped], folder / "map.onav", dem=dem, **usual, **area.build))


def _simulate(flight: Flight, place: Path) -> None:
    """Simulate a flight over the area in a folder."""
    area = AREAS[flight.area]
    frame = open_map(place / "map.onav").manifest.sheets[0].frame
    on_route = "random" not in flight.flown
    request = SimulateRequest(
        [place / "flown.tif"],
        place / f"flight{flight.seed}",
        camera=CAMERA,
        errors=Errors(**UNREPORTED, **flight.errors),
        seed=flight.seed,
        route=_zigzag(frame, area.side_px / 2) if on_route else None,
        terrain=None if area.hills_m is None else open_dem(place / "dem.tif"),
        terrain_posting_m=POSTING_M,
        **flight.flown,
    )
    with _same_on_every_processor():
        simulate_flight(request)


def instructions() -> str:
    """By which results are rounded: the widest vector instructions of this processor, and the
    kernels that NumPy's OpenBLAS takes for it (those of Haswell for a processor newer than it)."""
    wide = "avx2" if cv2.checkHardwareSupport(CPU_AVX2) else "others"
    if cv2.checkHardwareSupport(CPU_AVX512_SKX):
        wide = "avx512"
    found = [each for each in threadpool_info() if "numpy" in each["filepath"]]
    return " ".join((wide, *(each["architecture"] for each in found if "architecture" in each)))


def report(stored: Mapping[str, Any], found: Mapping[str, list[Row]]) -> str:
    """The views that differ from those of the file, the worst first; empty where none does."""
    here = stored["instructions"] == instructions()
    made = []
    for name, rows in found.items():
        before = stored["flights"].get(name, ())
        if len(before) != len(rows):
            made.append((math.inf, f"{name}: {len(before)} views became {len(rows)}"))
            continue
        for number, (was, now) in enumerate(zip(before, rows, strict=True), 1):
            times, text = _worst(was, now, here)
            if times > 1:
                made.append((times, f"{name}, view {number}: {text}"))
    if not made:
        return ""
    return "\n".join(
        (
            f"{len(made)} of {sum(map(len, found.values()))} golden views differ; the worst:",
            *(f"  {text}" for _, text in sorted(made, reverse=True)[:SHOWN]),
            "if this is intended: make golden, and give the reason in the commit",
        )
    )


def _worst(was: Row, now: Row, here: bool) -> tuple[float, str]:
    """The number of a view that is farthest beyond its tolerance: how often, and in words."""
    if _words(was) != _words(now):
        return math.inf, f"{_words(was) or 'fix'} became {_words(now) or 'fix'}"
    flat = not here and float(was.get("confidence", 1.0)) < FLAT_CONFIDENCE
    found = [(0.0, "")]
    for name, tolerance in (TOLERANCES if here else ON_OTHER_PROCESSORS).items():
        if name not in now:
            continue
        before, after = float(was[name]), float(now[name])
        off = abs(after - before)
        if name == "heading_deg":
            off = abs((after - before + 180) % 360 - 180)
        elif name == "std_m":
            off /= before
        times = off / (tolerance * (FLAT_TIMES if flat else 1.0))
        found.append((times, f"{name} {before:g} became {after:g}"))
    return max(found)


def _words(row: Row) -> dict[str, str]:
    return {name: value for name, value in row.items() if isinstance(value, str)}


def row_of(result: ViewResult, frame: LocalFrame) -> Row:
    """The numbers that are held: `east_m`, `north_m`, `std_m`, `heading_deg`, `confidence`."""
    outcome = result.outcome
    if isinstance(outcome, NoFix):
        return {"reason": outcome.reason}
    assert isinstance(outcome, Fix)
    east, north = frame.en_from_latlon(outcome.lat_deg, outcome.lon_deg)
    numbers = {
        "east_m": float(east),
        "north_m": float(north),
        "std_m": outcome.std_m,
        "heading_deg": outcome.heading_deg,
        "confidence": outcome.confidence,
    }
    state = {} if result.state is None else {"state": result.state}
    return {name: round(number, DIGITS) for name, number in numbers.items()} | state


@contextmanager
def _same_on_every_processor() -> Iterator[None]:
    """Views are drawn by the one interpolation of OpenCV whose result is the same to the bit with
    and without AVX: bilinear, of bytes. A single grey level would move some fixes by 20 cm."""
    remap = cv2.remap

    def linear(image: Any, columns: Any, rows: Any, _: int, **border: Any) -> Any:
        return remap(image, columns, rows, cv2.INTER_LINEAR, **border)

    def warped(image: Any, matrix: Any, size: tuple[int, int], flags: int, **border: Any) -> Any:
        assert flags & cv2.WARP_INVERSE_MAP
        column, row = np.meshgrid(*map(np.arange, size))
        along, down, scale = (a * column + b * row + c for a, b, c in matrix)
        maps = (along / scale).astype(np.float32), (down / scale).astype(np.float32)
        return remap(image, *maps, cv2.INTER_LINEAR, **border)

    with mock.patch.multiple(cv2, remap=linear, warpPerspective=warped):
        yield


def _cut(area: Area, name: str, out: Path) -> Path:
    """The part of an orthophoto that belongs to an area."""
    side = area.side_px
    with rasterio.open(IMAGERY / name) as data:
        window = Window(*area.corner_px, side, side)
        profile = {"crs": data.crs, "transform": data.window_transform(window), "dtype": "uint8"}
        bands, date = data.read(window=window), data.tags()["TIFFTAG_DATETIME"]
    with rasterio.open(
        out, "w", driver="GTiff", count=3, width=side, height=side, **profile
    ) as data:
        data.write(bands)
        data.update_tags(TIFFTAG_DATETIME=date)
    return out


def _write_hills(ortho: Path, out: Path, amplitude_m: float) -> Path:
    """A terrain under an orthophoto: waves of 600 and 450 m, heights above mean sea level."""
    margin_m = 100.0
    with rasterio.open(ortho) as data:
        crs, bounds = data.crs, data.bounds
    side = math.ceil((bounds.right - bounds.left + 2 * margin_m) / POSTING_M)
    along = (np.arange(side) + 0.5) * POSTING_M * 2 * np.pi
    heights = 200 + amplitude_m * np.sin(along / 600)[:, None] * np.cos(along / 450)
    west, north = bounds.left - margin_m, bounds.top + margin_m
    corner = Affine(POSTING_M, 0, west, 0, -POSTING_M, north)
    profile = {"crs": crs, "transform": corner, "dtype": "float32", "count": 1}
    with rasterio.open(out, "w", driver="GTiff", width=side, height=side, **profile) as data:
        data.write(heights.astype(np.float32), 1)
        data.update_tags(**{DATUM_TAG: "msl"})
    return out


def _zigzag(frame: LocalFrame, half_m: float) -> Route:
    lat, lon = frame.latlon_from_en(np.array(ZIGZAG) * half_m)
    return Route(tuple(zip(lat.tolist(), lon.tolist(), strict=True)))
