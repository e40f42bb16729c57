"""Camera, height and map chosen to suit each other, and what speaks against a choice.

The rules are those of the program: what a view must cover to be searched (`orthonav.localizer`),
and at which size it is registered well (docs/decisions/registration.md).
"""

import math
from dataclasses import dataclass

from orthonav.errors import CameraError
from orthonav.geo.camera import Camera

TILE_SIZES_PX = (256, 128, 64)
GOOD_VIEW_PX = 144.0
"""A view is finished where it is about so many pixels across; fewer are registered less well."""
LEAST_VIEW_PX = 24.0
LEAST_TILE_SHARE = 0.4
MOST_COARSER = 4.0
"""What is beyond these is refused: too_small, too_coarse."""
FINEST_IMAGERY_M = 0.2
"""Open orthophotos of whole countries are hardly ever finer (BD ORTHO: 0.2 m)."""
LOW_VIEW_M = 100.0
MOST_RELIEF = 0.05
"""Share of the height by which ground within a view may differ before it bends the view: as much as
the standard deviation of the told height that all is measured with."""
VIEW_OVERLAP = 0.6
TRACKED_PER_S = 10.0
"""Views a second while tracking, one core of a desktop: docs/benchmarks.md."""
_NICE = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)


@dataclass(frozen=True)
class Caution:
    """What speaks against a plan: a short word for programs and a sentence for people."""

    code: str
    text: str


@dataclass(frozen=True)
class ViewPlan:
    """What a camera sees of flat ground when it looks straight down from `agl_m`.

    `width_m` and `height_m` are the sides of the view, `gsd_m` the ground that a pixel covers,
    `spacing_m` the farthest that views may lie apart along the shorter side to overlap by
    `VIEW_OVERLAP`.
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
    def spacing_m(self) -> float:
        """The farthest that views may lie apart, in metres."""
        return (1 - VIEW_OVERLAP) * self.short_m

    def tile_share(self, tile_m: float) -> float:
        """Share of a tile `tile_m` wide that the view covers when both have the same heading."""
        return min(self.width_m, tile_m) * min(self.height_m, tile_m) / tile_m**2

    def across_px(self, gsd_m: float) -> float:
        """Pixels of a map across the view: the root of its area, as registration counts it."""
        return math.sqrt(self.width_m * self.height_m) / gsd_m


def suited_map(view: ViewPlan) -> tuple[float, int]:
    """Ground resolution in m and tile width in px to build with for a view.

    The coarsest round resolution at which the view covers a whole tile, with the widest tile for
    which that is neither finer than the view itself nor than `FINEST_IMAGERY_M`.
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
    """The largest round number that is not above a value."""
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    nice = max(each for each in _NICE if each * power <= value * (1 + 1e-9))
    return float(f"{nice * power:.3g}")


def view_cautions(view: ViewPlan, gsd_m: float, tile_px: int) -> list[Caution]:
    """What speaks against these views on a map of this ground resolution and tile width."""
    found = []
    tile_m = gsd_m * tile_px
    share, across_px = view.tile_share(tile_m), view.across_px(gsd_m)
    coarser = view.gsd_m / gsd_m
    if view.short_m < LOW_VIEW_M:
        found.append(
            Caution(
                "low",
                f"a view is only {view.short_m:.0f} m across: over forest or one large field it "
                "shows nothing that lasts, and trees and houses tilt by much; fly higher",
            )
        )
    if coarser > MOST_COARSER:
        text = f"a pixel of the view covers {coarser:.1f} pixels of the map: refused (too_coarse)"
        found.append(Caution("too_coarse", f"{text}; build coarser, or fly lower"))
    if across_px < LEAST_VIEW_PX:
        text = f"a view is {across_px:.0f} px of the map across: refused below {LEAST_VIEW_PX:.0f}"
        found.append(Caution("too_small", f"{text}; build finer, or fly higher"))
    elif across_px < GOOD_VIEW_PX * 0.999:
        text = (
            f"a view is {across_px:.0f} px of the map across, {GOOD_VIEW_PX:.0f} or more are good"
        )
        found.append(Caution("few_pixels", f"{text}; build finer, or fly higher"))
    if share < LEAST_TILE_SHARE:
        text = f"a view covers {share:.0%} of a tile: refused below {LEAST_TILE_SHARE:.0%} where "
        found.append(Caution("tile_too_large", f"{text}tiles are searched; use smaller tiles"))
    elif share < 0.999:
        text = f"a view covers {share:.0%} of a tile of {tile_m:.0f} m; whole tiles are found best"
        found.append(Caution("part_of_tile", text))
    if gsd_m < FINEST_IMAGERY_M * 0.999:
        text = f"orthophotos of {gsd_m:g} m are rare ({FINEST_IMAGERY_M:g} m is usual at best)"
        found.append(Caution("fine_imagery", text))
    return found


def rate_cautions(view: ViewPlan, speed_mps: float) -> list[Caution]:
    """What speaks against a speed over ground."""
    needed = speed_mps / view.spacing_m
    if needed <= TRACKED_PER_S:
        return []
    text = (
        f"at {speed_mps:g} m/s {needed:.0f} views a second are needed for {VIEW_OVERLAP:.0%} "
        f"overlap; a desktop core tracks about {TRACKED_PER_S:.0f}"
    )
    return [Caution("fast", text)]
