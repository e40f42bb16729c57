"""Flights over a terrain: the ground below, and the heights that an autopilot reports."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import AreaError
from orthonav.geo.frames import LocalFrame
from orthonav.geo.ground import TerrainHeights
from orthonav.records import Telemetry

Array = NDArray[np.float64]


def ground_below_m(terrain: TerrainHeights, frame: LocalFrame, places_en_m: Array) -> Array:
    """Heights of the ground (N,) above mean sea level below places (N, 2) of a plane.

    Raises `AreaError` where one is unknown.
    """
    lat, lon = frame.latlon_from_en(places_en_m)
    found = terrain(lat, lon)
    unknown = np.flatnonzero(~np.isfinite(found))
    if len(unknown):
        first = int(unknown[0])
        raise AreaError(
            f"the terrain has no height below a view, at {lat[first]:.5f}, {lon[first]:.5f}"
        )
    return found


def reported_heights(
    telemetry: Telemetry, agl_m: float, home_m: float | None, amsl_m: float
) -> Telemetry:
    """The telemetry with heights above sea and take-off in place of a measured one above ground.

    `agl_m`, `home_m`, `amsl_m`: true heights; all are reported with the error of that above ground.
    As in imports without a terrain, the height above take-off stands for that above ground.
    """
    error_m = telemetry.agl_m - agl_m
    above_home_m = None if home_m is None else round(home_m + error_m, 3)
    return replace(
        telemetry,
        agl_m=math.nan if above_home_m is None else above_home_m,
        home_m=above_home_m,
        amsl_m=round(amsl_m + error_m, 3),
    )
