"""Height above ground along a route, and relief within a view."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import RouteError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import TerrainHeights
from orthonav.ground.planning.route import Route, leg_lengths_m
from orthonav.ground.planning.spacing import MOST_RELIEF, Caution

Array = NDArray[np.float64]
MAX_POSITIONS = 2000
"""Sampled positions along a route at most."""
LANDING_M = 30.0
"""Height above ground below which the aircraft takes off or lands; views there are not judged."""
_BELOW_GROUND_M = 2.0
"""Tolerance for errors of the terrain model."""
_ACROSS = (0.0, -0.5, 0.5)
_VIEW = [(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.0, 0.5)]


@dataclass(frozen=True)
class LegProfile:
    """A leg over terrain.

    `leg`: number, from 1. `length_m`: its length. `ground_m`: minimum and maximum terrain height
    above mean sea level along it. `agl_m`: minimum and maximum height above ground. `relief`:
    largest difference of terrain height within a view centred on the leg or on an edge of its
    search band, as a share of the height above ground; 0 below `LANDING_M`.
    """

    leg: int
    length_m: float
    ground_m: tuple[float, float]
    agl_m: tuple[float, float]
    relief: float


def profile(
    route: Route,
    bands_m: tuple[float, ...],
    agl_m: float | None,
    view_m: float,
    terrain: TerrainHeights,
) -> list[LegProfile]:
    """Height above ground and relief of each leg.

    `bands_m`: search bands of the legs. `agl_m`: constant height above ground for legs without
    known heights. `view_m`: width of a view. Raises `RouteError` if a height is unknown, or if the
    terrain does not cover the route.
    """
    spacing_m = max(view_m / 2, float(leg_lengths_m(route).sum()) / MAX_POSITIONS, 1.0)
    home_m = route.home_amsl_m
    if home_m is None:
        first = np.array([route.waypoints[0]])
        home_m = float(terrain(first[:, 0], first[:, 1])[0])
    return [
        _leg(route, leg, bands_m[leg], agl_m, view_m, spacing_m, home_m, terrain)
        for leg in range(route.legs)
    ]


def _leg_m(route: Route, leg: int) -> tuple[LocalFrame, float, Array]:
    """A local plane at a leg, its length, and both ends in the plane (2, 2)."""
    ends = route.part(leg, min(leg + 1, len(route.waypoints) - 1))
    frame = LocalFrame(*ends.waypoints[0])
    points = ends.points_en_m(frame)
    return frame, float(np.linalg.norm(points[-1] - points[0])), points[[0, -1]]


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
    frame, length_m, (start, end) = _leg_m(route, leg)
    along = (end - start) / length_m if length_m > 0 else np.array([1.0, 0.0])
    across = np.array([along[1], -along[0]])
    shares = np.linspace(0, 1, math.ceil(length_m / spacing_m) + 1)
    places = start + shares[:, None] * (end - start)
    centres = places[:, None, :] + np.array(_ACROSS)[:, None] * band_m * across
    seen = centres[:, :, None, :] + np.array(_VIEW) * view_m
    lat, lon = frame.latlon_from_en(seen)
    heights = terrain(lat.ravel(), lon.ravel()).reshape(lat.shape)
    middle = heights[..., len(_VIEW) // 2]
    if not np.isfinite(middle[:, 0]).all():
        raise RouteError(f"the terrain does not cover leg {leg + 1} of the route")
    if not np.isfinite(home_m):
        raise RouteError("the terrain does not cover the take-off position (the first waypoint)")
    flown = _flown_amsl_m(route, leg, agl_m, shares, middle[:, 0], home_m)
    over = flown - middle[:, 0]
    known = np.isfinite(heights).all(axis=-1)
    clear = flown[:, None] - middle
    judged = known & (clear >= LANDING_M)
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
    """Flown heights above mean sea level at shares of a leg, over the terrain heights `below`."""
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
    """Cautions about a route over this terrain."""
    found = []
    low = [leg.leg for leg in legs if leg.agl_m[0] < -_BELOW_GROUND_M]
    steep = [leg for leg in legs if leg.relief > MOST_RELIEF and leg.leg not in low]
    if low:
        text = f"{_named(low)} would pass below the terrain"
        found.append(Caution("ground", text))
    if steep:
        most = max(leg.relief for leg in steep)
        text = (
            f"relief within a view is up to {most:.0%} of the height on "
            f"{_named([leg.leg for leg in steep])}; above {MOST_RELIEF:.0%} it distorts the view"
        )
        found.append(Caution("relief", text))
    return found


def _named(legs: list[int]) -> str:
    shown = ", ".join(map(str, legs[:10])) + (", .." if len(legs) > 10 else "")
    return f"leg {shown}" if len(legs) == 1 else f"legs {shown}"
