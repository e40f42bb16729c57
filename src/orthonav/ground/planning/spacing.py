"""Matching of camera, height and map, and cautions about unsuitable combinations.

The limits are those of the localizer (`orthonav.core.localize`) and of registration
(docs/decisions/registration.md).
"""

import math
from dataclasses import dataclass

from orthonav.core.errors import CameraError
from orthonav.core.geo.camera import Camera

TILE_SIZES_PX = (256, 128, 64)
"""Tile widths to choose from, widest first; 256 px is the default of `build`."""
GOOD_VIEW_PX = 144.0
"""Size of a view, in map pixels, at which registration ends; smaller views register less well."""
LEAST_VIEW_PX = 24.0
LEAST_TILE_SHARE = 0.4
MOST_COARSER = 4.0
"""The localizer refuses views beyond these three limits: too_small, too_coarse."""
FINEST_IMAGERY_M = 0.2
"""Open orthophotos of whole countries are rarely finer (BD ORTHO: 0.2 m)."""
LOW_VIEW_M = 100.0
"""Below this a single field or wood can fill the view."""
MOST_RELIEF = 0.05
"""Relief within a view, as a share of the height, above which the flat-ground model fails: equal to
the standard deviation of the reported height in all benchmarks."""
VIEW_OVERLAP = 0.6
"""Usual forward overlap of aerial photography."""
TRACKED_PER_S = 10.0
"""Views per second while tracking on one desktop core: docs/benchmarks.md."""
DEFAULT_CAMERA = Camera(1280, 960, 1000.0, 1000.0, 640.0, 480.0)
"""A field of view of 65 by 51 degrees, usual for small drones."""
DEFAULT_PRIOR_STD_M = 150.0
"""About 5 km of dead reckoning with an error of 3 %."""
BAND_PRIORS = 4.0
"""Width of a band that is not given, in standard deviations of the prior: two to each side."""
MIN_BAND_VIEWS = 0.5
"""A band is checked at least so many sides of a view wide."""
_NICE = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
"""Mantissas of round ground resolutions."""


def default_band_m(view_m: float, prior_std_m: float | None = DEFAULT_PRIOR_STD_M) -> float:
    """Width of the search band of a route, for views of `view_m` and a prior position, if any."""
    priors = BAND_PRIORS * (view_m if prior_std_m is None else prior_std_m)
    return max(priors, MIN_BAND_VIEWS * view_m)


@dataclass(frozen=True)
class Caution:
    """A warning about a plan: `code` for programs, `text` for people."""

    code: str
    text: str


@dataclass(frozen=True)
class ViewPlan:
    """Footprint of a vertical view of flat ground.

    `agl_m`: height above ground. `width_m`, `height_m`: sides of the footprint. `gsd_m`: ground
    resolution, metres per pixel.
    """

    agl_m: float
    width_m: float
    height_m: float
    gsd_m: float

    @classmethod
    def of(cls, camera: Camera, agl_m: float) -> "ViewPlan":
        """The view from a height above ground. Raises `CameraError` on an impossible height."""
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
        """The shorter side in metres."""
        return min(self.width_m, self.height_m)

    @property
    def side_m(self) -> float:
        """Root of the area in metres."""
        return math.sqrt(self.width_m * self.height_m)

    @property
    def spacing_m(self) -> float:
        """Largest distance between views that overlap by `VIEW_OVERLAP` along the shorter side."""
        return (1 - VIEW_OVERLAP) * self.short_m

    def tile_share(self, tile_m: float) -> float:
        """Share of a tile of width `tile_m` covered by the view at the same heading."""
        return min(self.width_m, tile_m) * min(self.height_m, tile_m) / tile_m**2

    def across_px(self, gsd_m: float) -> float:
        """Size of the view in map pixels: the square root of its area, as in registration."""
        return math.sqrt(self.width_m * self.height_m) / gsd_m


def suited_map(view: ViewPlan) -> tuple[float, int]:
    """Suitable ground resolution (m) and tile width (px) of a map for a view.

    The coarsest round resolution at which the view covers a whole tile, with the widest tile for
    which this is neither finer than the view itself nor than `FINEST_IMAGERY_M`.
    """
    finest_m = max(FINEST_IMAGERY_M, view.gsd_m)
    for tile_px in TILE_SIZES_PX:
        gsd_m = _nice_below(view.short_m / tile_px)
        if gsd_m >= finest_m:
            return gsd_m, tile_px
    return float(f"{finest_m:.3g}"), TILE_SIZES_PX[-1]


def suited_tile_px(view: ViewPlan, gsd_m: float) -> int:
    """The widest tile that the view covers at a given ground resolution, else the smallest."""
    return next(
        (px for px in TILE_SIZES_PX if px * gsd_m <= view.short_m * 1.001), TILE_SIZES_PX[-1]
    )


def _nice_below(value: float) -> float:
    """The largest round number not above a value."""
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    nice = max(each for each in _NICE if each * power <= value * (1 + 1e-9))
    return float(f"{nice * power:.3g}")


def view_cautions(view: ViewPlan, gsd_m: float, tile_px: int) -> list[Caution]:
    """Cautions about views on a map of this ground resolution and tile width."""
    found = []
    tile_m = gsd_m * tile_px
    share, across_px = view.tile_share(tile_m), view.across_px(gsd_m)
    coarser = view.gsd_m / gsd_m
    if view.short_m < LOW_VIEW_M:
        found.append(
            Caution(
                "low",
                f"a view is only {view.short_m:.0f} m across: over forest or one large field it "
                "shows no lasting structure, and relief displacement of trees and houses is large; "
                "fly higher",
            )
        )
    if coarser > MOST_COARSER:
        text = f"a pixel of the view covers {coarser:.1f} pixels of the map: refused (too_coarse)"
        found.append(Caution("too_coarse", f"{text}; build coarser, or fly lower"))
    if across_px < LEAST_VIEW_PX:
        text = f"a view is {across_px:.0f} map pixels across: refused below {LEAST_VIEW_PX:.0f}"
        found.append(Caution("too_small", f"{text}; build finer, or fly higher"))
    elif across_px < GOOD_VIEW_PX * 0.999:
        text = f"a view is {across_px:.0f} map pixels across, fewer than {GOOD_VIEW_PX:.0f}"
        found.append(Caution("few_pixels", f"{text}; build finer, or fly higher"))
    if share < LEAST_TILE_SHARE:
        text = f"a view covers {share:.0%} of a tile: tile search refuses below "
        found.append(Caution("tile_too_large", f"{text}{LEAST_TILE_SHARE:.0%}; use smaller tiles"))
    elif share < 0.999:
        text = f"a view covers {share:.0%} of a tile of {tile_m:.0f} m; best is a whole tile"
        found.append(Caution("part_of_tile", text))
    if gsd_m < FINEST_IMAGERY_M * 0.999:
        text = f"orthophotos of {gsd_m:g} m are rare ({FINEST_IMAGERY_M:g} m is the usual minimum)"
        found.append(Caution("fine_imagery", text))
    return found


def rate_cautions(view: ViewPlan, speed_mps: float) -> list[Caution]:
    """Cautions about a ground speed."""
    needed = speed_mps / view.spacing_m
    if needed <= TRACKED_PER_S:
        return []
    text = (
        f"{VIEW_OVERLAP:.0%} overlap at {speed_mps:g} m/s needs {needed:.0f} views per second; a "
        f"desktop core tracks about {TRACKED_PER_S:.0f}"
    )
    return [Caution("fast", text)]
