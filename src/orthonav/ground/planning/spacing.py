"""Matching of camera, height, map and terrain: cautions about unsuitable combinations, and what the
map of an area will take.

The limits are those of the localizer (`orthonav.core.localize`) and of registration
(docs/decisions/registration.md)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, RouteError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.ground import TerrainHeights
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.record import listed
from orthonav.ground.planning.route import Route, leg_lengths_m

DEFAULT_CAMERA = Camera(1280, 960, 1000.0, 1000.0, 640.0, 480.0)  # 65 by 51 deg
DEFAULT_PRIOR_STD_M = 150.0  # about 5 km of dead reckoning with an error of 3 %
MIN_BAND_VIEWS = 0.5  # a band is checked at least so many sides of a view wide
Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlanLimits:
    """Where advice changes and cautions begin."""

    good_view_px: float = 144.0  # size of a view in map pixels at which registration ends
    min_view_px: float = 24.0  # the localizer refuses smaller views: too_small
    min_tile_share: float = 0.4  # tile search refuses views that cover less of a tile
    max_coarser: float = 4.0  # map pixels a pixel of the view; refused beyond: too_coarse
    finest_imagery_m: float = 0.2  # orthophotos of whole countries are rarely finer (BD ORTHO)
    low_view_m: float = 100.0  # below this a single field or wood can fill the view
    max_relief: float = 0.05  # within a view, a fraction of the height: std of reported heights
    view_overlap: float = 0.6  # usual forward overlap of aerial photography
    landing_m: float = 30.0  # above ground, below which the aircraft takes off or lands
    max_below_ground_m: float = 2.0  # tolerance for errors of the terrain model
    tile_sizes_px: tuple[int, ...] = (256, 128, 64)  # to choose from; `build` defaults to 256


LIMITS = PlanLimits()


def default_band_m(view_m: float, prior_std_m: float | None = DEFAULT_PRIOR_STD_M) -> float:
    """Width of a band that is not given: two deviations of the prior to each side."""
    priors = 4 * (view_m if prior_std_m is None else prior_std_m)
    return max(priors, MIN_BAND_VIEWS * view_m)


@dataclass(frozen=True)
class Caution:
    code: str
    text: str


@dataclass(frozen=True)
class ViewPlan:
    agl_m: float  # height above ground
    width_m: float
    height_m: float
    gsd_m: float  # ground resolution, metres per pixel

    @classmethod
    def of(cls, camera: Camera, agl_m: float) -> "ViewPlan":
        if not 1 <= agl_m <= 50_000:
            raise CameraError(f"height above ground must be 1 to 50,000 m, got {agl_m}")
        return cls(
            agl_m,
            agl_m * camera.width_px / camera.fx_px,
            agl_m * camera.height_px / camera.fy_px,
            camera.gsd_m(agl_m),
        )

    @property
    def short_m(self) -> float:
        return min(self.width_m, self.height_m)

    @property
    def side_m(self) -> float:
        return math.sqrt(self.width_m * self.height_m)

    @property
    def spacing_m(self) -> float:
        return (1 - LIMITS.view_overlap) * self.short_m

    def tile_share(self, tile_m: float) -> float:
        return min(self.width_m, tile_m) * min(self.height_m, tile_m) / tile_m**2

    def across_px(self, gsd_m: float) -> float:
        """Size of the view in map pixels: the square root of its area, as in registration."""
        return self.side_m / gsd_m


def suited_map(view: ViewPlan) -> tuple[float, int]:
    """The coarsest round resolution (m) at which the view covers a whole tile, and the widest tile
    (px) for which this is neither finer than the view nor than imagery usually is."""
    finest_m = max(LIMITS.finest_imagery_m, view.gsd_m)
    for tile_px in LIMITS.tile_sizes_px:
        gsd_m = _round_below(view.short_m / tile_px)
        if gsd_m >= finest_m:
            return gsd_m, tile_px
    return float(f"{finest_m:.3g}"), LIMITS.tile_sizes_px[-1]


def suited_tile_px(view: ViewPlan, gsd_m: float) -> int:
    sizes = LIMITS.tile_sizes_px
    return next((px for px in sizes if px * gsd_m <= view.short_m * 1.001), sizes[-1])


def _round_below(value: float) -> float:
    """The largest round ground resolution up to a value."""
    mantissas = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    largest = max(each for each in mantissas if each * power <= value * (1 + 1e-9))
    return float(f"{largest * power:.3g}")


def view_cautions(view: ViewPlan, gsd_m: float, tile_px: int) -> list[Caution]:
    tile_m, coarser = gsd_m * tile_px, view.gsd_m / gsd_m
    share, across_px = view.tile_share(tile_m), view.across_px(gsd_m)
    across = f"a view is {across_px:.0f} map pixels across"
    covers = f"a view covers {share:.0%} of a tile"
    low, tiny = view.short_m < LIMITS.low_view_m, across_px < LIMITS.min_view_px
    few = not tiny and across_px < LIMITS.good_view_px * 0.999
    small = share < LIMITS.min_tile_share
    rows = [
        (low, "low", f"a view is only {view.short_m:.0f} m across: over forest or one large field "
         "it shows no lasting structure, and relief displacement of trees and houses is large; "
         "fly higher"),
        (coarser > LIMITS.max_coarser, "too_coarse", f"a pixel of the view covers {coarser:.1f} "
         "pixels of the map: refused (too_coarse); build coarser, or fly lower"),
        (tiny, "too_small",
         f"{across}: refused below {LIMITS.min_view_px:.0f}; build finer, or fly higher"),
        (few, "few_pixels",
         f"{across}, fewer than {LIMITS.good_view_px:.0f}; build finer, or fly higher"),
        (small, "tile_too_large",
         f"{covers}: tile search refuses below {LIMITS.min_tile_share:.0%}; use smaller tiles"),
        (not small and share < 0.999, "part_of_tile",
         f"{covers} of {tile_m:.0f} m; best is a whole tile"),
    ]  # fmt: skip
    return [Caution(code, text) for holds, code, text in rows if holds]


@dataclass(frozen=True)
class MapEstimate:
    """Estimate for a map of one sheet. `build_s`: time of the default build on one desktop core,
    with registration; training a network takes hours more."""

    area_km2: float  # area covered by tile centres
    imagery_km2: float  # area of the pixels under the tiles
    tiles: int  # number of reference tiles
    map_mb: tuple[float, float]  # smallest and largest expected file size
    build_s: float


def estimate_map(
    area: Area, *, gsd_m: float, tile_px: int, overlap: float, maps: int = 1
) -> MapEstimate:
    """Tiles are counted if that is cheap, else estimated from a sample (within 2 %), which is
    smaller where this is one of many `maps`. Imagery is assumed everywhere.

    Bytes: docs/benchmarks.md (4.26 MB for 15,601 tiles) and docs/map-format.md. Time: one worker on
    a core of an AMD EPYC, 1 m, 179 s for a corridor of 284 million pixels; 40 s calibrate the
    confidence."""
    grid = TileGrid.covering(area.extent_en_m, gsd_m=gsd_m, tile_px=tile_px, overlap=overlap)
    room = max(2_500, 200_000 // maps)  # points: a standard error of 0.1 % to 1 %
    border_m = (grid.tile_m - grid.stride_m) / 2

    def inside(rows: int, cols: int, border_m: float, margin_m: float) -> float:
        """How many of the cells of the grid, less its border, lie in the area or within a margin
        of it, by the centres of all of them or of at most about `room` larger ones."""
        if area.route is None:
            return float(rows * cols)
        step = max(1.0, math.sqrt(rows * cols / room))
        down, across = math.ceil(rows / step), math.ceil(cols / step)
        width_m = grid.width_px * gsd_m - 2 * border_m
        height_m = grid.height_px * gsd_m - 2 * border_m
        x = grid.west_m + border_m + (np.arange(across) + 0.5) * width_m / across
        y = grid.north_m - border_m - (np.arange(down) + 0.5) * height_m / down
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return rows * cols * float(area.contains(points, margin_m).mean())

    tiles = round(inside(grid.rows, grid.cols, border_m, grid.stride_m * math.sqrt(0.5)))
    pixels = inside(grid.height_px, grid.width_px, 0.0, grid.tile_m / 2)
    low_mb, high_mb = (pixels * per_px / 1e6 for per_px in (0.15, 0.35))
    embeddings_mb = tiles * 273 / 1e6
    return MapEstimate(
        area_km2=tiles * grid.stride_m**2 / 1e6,
        imagery_km2=pixels * gsd_m**2 / 1e6,
        tiles=tiles,
        map_mb=(embeddings_mb + low_mb, embeddings_mb + high_mb),
        build_s=40 + 0.5 * pixels / 1e6,
    )


@dataclass(frozen=True)
class LegProfile:
    """`relief`: largest difference of terrain height within a view centred on the leg or on an edge
    of its search band, as a fraction of the height above ground; 0 near the ground."""

    leg: int  # number, from 1
    length_m: float  # its length
    ground_m: tuple[float, float]  # minimum and maximum terrain height above mean sea level
    agl_m: tuple[float, float]  # minimum and maximum height above ground
    relief: float


def profile(
    route: Route,
    bands_m: tuple[float, ...],
    agl_m: float | None,
    view_m: float,
    terrain: TerrainHeights,
) -> list[LegProfile]:
    """Height above ground and relief of each leg. `bands_m`: search bands of the legs. `agl_m`:
    constant height above ground for legs without known heights. `view_m`: width of a view."""
    spacing_m = max(view_m / 2, float(leg_lengths_m(route).sum()) / 2000, 1.0)
    home_m = route.home_amsl_m
    if home_m is None:
        first = np.array([route.waypoints[0]])
        home_m = float(terrain(first[:, 0], first[:, 1])[0])
    return [
        _leg(route, leg, bands_m[leg], agl_m, view_m, spacing_m, home_m, terrain)
        for leg in range(route.legs)
    ]


def flown_agl_m(route: Route, terrain: TerrainHeights | None) -> list[float]:
    """Known heights above ground along a route, without take-off and landing: as planned, or where
    not all are planned so, over a terrain."""
    heights = [height for height in route.heights if height is not None]
    planned = [height.height_m for height in heights if height.frame == "agl"]
    if heights and len(planned) < len(heights) and terrain is not None:
        legs = profile(route, (0.0,) * route.legs, None, 0.0, terrain)
        planned = [height for leg in legs for height in leg.agl_m]
    return [height for height in planned if height >= LIMITS.landing_m]


def _leg(
    route: Route,
    leg: int,
    band_m: float,
    agl_m: float | None,
    view_m: float,
    spacing_m: float,
    home_m: float,
    terrain: TerrainHeights,
) -> LegProfile:
    ends = route.part(leg, min(leg + 1, len(route.waypoints) - 1))
    frame = LocalFrame(*ends.waypoints[0])
    start, end = ends.points_en_m(frame)[[0, -1]]
    length_m = float(np.linalg.norm(end - start))
    along = (end - start) / length_m if length_m > 0 else np.array([1.0, 0.0])
    across = np.array([along[1], -along[0]])
    shares = np.linspace(0, 1, math.ceil(length_m / spacing_m) + 1)
    places = start + shares[:, None] * (end - start)
    band = np.array([0.0, -0.5, 0.5])  # the line and both edges of the band
    view = np.array([(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.0, 0.5)])
    centres = places[:, None, :] + band[:, None] * band_m * across
    seen = centres[:, :, None, :] + view * view_m
    lat, lon = frame.latlon_from_en(seen)
    heights = terrain(lat.ravel(), lon.ravel()).reshape(lat.shape)
    middle = heights[..., len(view) // 2]
    if holes := float(np.isnan(middle[:, 0]).mean()):
        raise RouteError(
            f"the terrain has no height for {holes:.0%} of leg {leg + 1} of the route (a hole, or "
            "beyond its edge)"
        )
    if not np.isfinite(home_m):
        raise RouteError("the terrain does not cover the take-off position (the first waypoint)")
    flown = _flown_amsl_m(route, leg, agl_m, shares, middle[:, 0], home_m)
    over = flown - middle[:, 0]
    known = np.isfinite(heights).all(axis=-1)
    clear = flown[:, None] - middle
    judged = known & (clear >= LIMITS.landing_m)
    relief = np.ptp(np.where(judged[..., None], heights, 0), axis=-1) / np.where(judged, clear, 1)
    return LegProfile(
        leg + 1,
        length_m,
        (float(middle[:, 0].min()), float(middle[:, 0].max())),
        (float(over.min()), float(over.max())),
        float(relief.max()),
    )


def _flown_amsl_m(
    route: Route, leg: int, agl_m: float | None, shares: Array, below: Array, home_m: float
) -> Array:
    ends = route.heights[leg : leg + 2]
    frames = {None if height is None else height.frame for height in ends}
    if not ends or not frames.isdisjoint({None, "hae"}) or len(frames) > 1:
        if agl_m is None:
            raise RouteError(
                f"the height of leg {leg + 1} of the route, or its reference, is unknown, or it is "
                "above the ellipsoid; give the height above ground (--agl-m)"
            )
        return below + agl_m
    known = [height.height_m for height in ends if height is not None]
    heights = known[0] + shares * (known[-1] - known[0])
    base = {"agl": below, "home": np.array(home_m), "amsl": np.array(0.0)}
    return np.asarray(base[str(frames.pop())] + heights)


def terrain_cautions(legs: list[LegProfile]) -> list[Caution]:
    found = []
    low = [leg for leg in legs if leg.agl_m[0] < -LIMITS.max_below_ground_m]
    steep = [leg for leg in legs if leg.relief > LIMITS.max_relief and leg not in low]
    if low:
        hint = "heights of one may be in feet, or of another datum"
        found.append(Caution("ground", f"{_named(low)} would pass below the terrain: {hint}"))
    if steep:
        most = max(leg.relief for leg in steep)
        text = (
            f"relief within a view is up to {most:.0%} of the height on {_named(steep)}; "
            f"above {LIMITS.max_relief:.0%} it distorts the view"
        )
        found.append(Caution("relief", text))
    return found


def _named(legs: list[LegProfile]) -> str:
    shown = listed([str(leg.leg) for leg in legs], 10)
    return f"leg {shown}" if len(legs) == 1 else f"legs {shown}"
