"""Height above ground along a route, and how much the ground differs within a view."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import RouteError
from orthonav.geo.frames import LocalFrame
from orthonav.geo.planning import MOST_RELIEF, Caution
from orthonav.geo.route import Route, leg_lengths_m

Array = NDArray[np.float64]
Ground = Callable[[Array, Array], Array]
"""Heights above mean sea level in m of places given in degrees; NaN where they are not known."""
MAX_POSITIONS = 2000
LANDING_M = 30.0
"""Lower than this an aircraft takes off or lands: what it sees then is not judged."""
_BELOW_GROUND_M = 2.0
_ACROSS = (0.0, -0.5, 0.5)
_VIEW = [(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.0, 0.5)]


@dataclass(frozen=True)
class LegProfile:
    """A leg over terrain. Metres; `leg` counts from 1.

    `ground_m` and `agl_m` are least and most along the leg, ground above mean sea level, height
    above ground. `relief` is the most by which ground differs within a view that is centred
    on the leg or at a border of its search band, as a share of the height there; 0 where the
    aircraft is lower than `LANDING_M`.
    """

    leg: int
    length_m: float
    ground_m: tuple[float, float]
    agl_m: tuple[float, float]
    relief: float


def profile(
    route: Route, bands_m: tuple[float, ...], agl_m: float | None, view_m: float, ground: Ground
) -> list[LegProfile]:
    """Height above ground leg by leg.

    `bands_m` are the search bands of the legs; `agl_m` is the height above ground where the route
    says none (or not above what), flown so all along; `view_m` is the width of a view. Raises
    `RouteError` where a height is not known, or the terrain does not reach.
    """
    spacing_m = max(view_m / 2, float(leg_lengths_m(route).sum()) / MAX_POSITIONS, 1.0)
    home_m = route.home_amsl_m
    if home_m is None:
        first = np.array([route.waypoints[0]])
        home_m = float(ground(first[:, 0], first[:, 1])[0])
    return [
        _leg(route, leg, bands_m[leg], agl_m, view_m, spacing_m, home_m, ground)
        for leg in range(route.legs)
    ]


def _leg_m(route: Route, leg: int) -> tuple[LocalFrame, float, Array]:
    """A plane about a leg, its length, and both ends in the plane (2, 2)."""
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
    ground: Ground,
) -> LegProfile:
    frame, length_m, (start, end) = _leg_m(route, leg)
    along = (end - start) / length_m if length_m > 0 else np.array([1.0, 0.0])
    across = np.array([along[1], -along[0]])
    shares = np.linspace(0, 1, math.ceil(length_m / spacing_m) + 1)
    places = start + shares[:, None] * (end - start)
    centres = places[:, None, :] + np.array(_ACROSS)[:, None] * band_m * across
    seen = centres[:, :, None, :] + np.array(_VIEW) * view_m
    lat, lon = frame.latlon_from_en(seen)
    heights = ground(lat.ravel(), lon.ravel()).reshape(lat.shape)
    middle = heights[..., len(_VIEW) // 2]
    if not np.isfinite(middle[:, 0]).all():
        raise RouteError(f"the terrain does not reach leg {leg + 1} of the route")
    if not np.isfinite(home_m):
        raise RouteError("the terrain does not reach the take-off place (the first waypoint)")
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
    """Heights above mean sea level that are flown at shares of a leg, over the ground `below`."""
    ends = route.heights[leg : leg + 2]
    frames = {None if height is None else height.frame for height in ends}
    if not ends or None in frames or len(frames) > 1:
        if agl_m is None:
            raise RouteError(
                f"route does not say how high leg {leg + 1} is flown, and above what; give the "
                "height above ground (--agl-m)"
            )
        return below + agl_m
    told = [height.height_m for height in ends if height is not None]
    heights = told[0] + shares * (told[-1] - told[0])
    base = {"agl": below, "home": np.array(home_m), "amsl": np.array(0.0)}
    return np.asarray(base[str(frames.pop())] + heights)


def terrain_cautions(legs: list[LegProfile]) -> list[Caution]:
    """What speaks against a route over this terrain."""
    found = []
    low = [leg.leg for leg in legs if leg.agl_m[0] < -_BELOW_GROUND_M]
    steep = [leg for leg in legs if leg.relief > MOST_RELIEF and leg.leg not in low]
    if low:
        text = f"{_named(low)} would be flown into the ground"
        found.append(Caution("ground", text))
    if steep:
        most = max(leg.relief for leg in steep)
        text = (
            f"ground within a view differs by up to {most:.0%} of the height on "
            f"{_named([leg.leg for leg in steep])} (above {MOST_RELIEF:.0%} hills bend the view)"
        )
        found.append(Caution("relief", text))
    return found


def _named(legs: list[int]) -> str:
    shown = ", ".join(map(str, legs[:10])) + (", .." if len(legs) > 10 else "")
    return f"leg {shown}" if len(legs) == 1 else f"legs {shown}"
