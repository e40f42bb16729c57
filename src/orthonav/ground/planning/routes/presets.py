"""Preset routes at any position: the trajectories A to D of the paper.

Di Piazza et al. (IGARSS 2024), Table 1. The paper states altitude, length, search band and overlap;
it does not state the ground resolution: 0.2 m is assumed for A, 1 m for B and D, 2 m for C, so that
a tile of 256 px has about the size of a view from 40, 2000 and 4000 m. The paper does not draw the
trajectories; they are straight here.
"""

import math
from dataclasses import dataclass

import numpy as np

from orthonav.core.errors import RouteError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.swapped import swapped_hint
from orthonav.ground.planning.routes.record import Height, Route

PREFIX = "paper:"
EAST_DEG = 90.0
_FORM = f"{PREFIX}A@LAT,LON[,BEARING]"


@dataclass(frozen=True)
class PaperTrajectory:
    """A column of Table 1, and the ground resolution taken for it."""

    name: str
    agl_m: float
    length_m: float
    band_m: float
    overlap: float
    gsd_m: float


TABLE_1 = {
    "A": PaperTrajectory("A", 40, 150, 10, 0.995, 0.2),
    "B": PaperTrajectory("B", 2000, 12_000, 1000, 0.875, 1.0),
    "C": PaperTrajectory("C", 4000, 50_000, 5000, 0.875, 2.0),
    "D": PaperTrajectory("D", 2000, 2000, 2000, 0.875, 1.0),
}


def preset(text: str) -> Route:
    """The route that `paper:A@46.6,1.9` or `paper:A@46.6,1.9,30` names.

    A straight line of the trajectory's length about that centre, flown at its height, with its
    search band; the bearing is in degrees clockwise from north, 90 where it is not given. Raises
    `RouteError`.
    """
    name, _, where = text.removeprefix(PREFIX).partition("@")
    shape = TABLE_1.get(name.upper())
    if shape is None:
        raise RouteError(f"preset must be one of {', '.join(TABLE_1)} as {_FORM}, got '{text:.60}'")
    try:
        numbers = [float(value) for value in where.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        raise RouteError(f"preset must be {_FORM} with numbers in degrees, got '{text:.60}'")
    lat_deg, lon_deg, *bearing = numbers
    if not (abs(lat_deg) <= 89 and abs(lon_deg) <= 360):
        raise RouteError(
            "the centre of a preset needs a latitude of -89 to 89 and a longitude of -360 to 360, "
            f"got {lat_deg}, {lon_deg}{swapped_hint(lat_deg, lon_deg)}"
        )
    turn = math.radians(bearing[0] if bearing else EAST_DEG)
    half_m = shape.length_m / 2
    ends = np.array([[-half_m], [half_m]]) * [math.sin(turn), math.cos(turn)]
    lat, lon = LocalFrame(lat_deg, lon_deg).latlon_from_en(ends)
    return Route(
        tuple(zip(lat.tolist(), lon.tolist(), strict=True)),
        (Height(shape.agl_m, "agl"),) * 2,
        (shape.band_m,),
        f"{PREFIX}{shape.name}",
    )
