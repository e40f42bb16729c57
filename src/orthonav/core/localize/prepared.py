"""A view made ready for registration: rectified with its own heading up, as templates."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize.checks import MIN_VIEW_PX, check_footprint, footprint_side_m
from orthonav.core.localize.rectify import (
    RectifiedView,
    downsampled,
    is_oblique,
    near_part,
    rectify_footprint,
)
from orthonav.core.records import (
    DEFAULT_AGL_STD,
    DEFAULT_YAW_STD_DEG,
    MIN_YAW_STD_DEG,
    NoFix,
    Telemetry,
    View,
)
from orthonav.core.register.registrar import Levels, PosePrior
from orthonav.core.register.template import ViewTemplates

MIN_AGL_STD = 0.03
"""Least standard deviation of the log scale that is searched, whatever the telemetry reports."""
MAX_AGL_STD = 0.15
"""Largest one: three of them are scales of 0.64 to 1.57, about as far as scores of chance were
measured to be alike (docs/decisions/registration.md)."""
NEAR_SHARE = 0.6
"""The part of a view far off nadir is judged as one so many times smaller, thus mostly one level
finer: it is no square, and on its coarse levels too little is left of it
(docs/decisions/terrain.md)."""


@dataclass(frozen=True, eq=False)
class PreparedView:
    """A view made ready for registration.

    `picture_at`: the view averaged towards the ground resolution of a level. `rectified_at`: makes
    the view rectified at the ground resolution of a level. `templates`: its evidence.
    `levels`: levels of the map at which it is searched, judged and finished. `side_px`: root of the
    area seen, in pixels of level 0. `camera_px` (2,): the camera as seen from the middle of the
    view, heading up, x to the right and y down, in pixels of level 0. `prior`: expected heading and
    scale.
    """

    picture_at: Callable[[int], View]
    rectified_at: Callable[[int], RectifiedView]
    templates: ViewTemplates
    levels: Levels
    side_px: float
    camera_px: NDArray[np.float64]
    prior: PosePrior


def prepare(view: View, gsd_m: float, map_levels: int, heading_known: bool) -> PreparedView | NoFix:
    """The view rectified at the level where it is finished; `NoFix` where it shows too little.

    `gsd_m` is the ground resolution of level 0 of the map, `map_levels` the number of its levels.
    """
    camera, telemetry = view.camera, view.telemetry
    nominal_m = footprint_side_m(telemetry, camera)
    if is_oblique(view):
        near = near_part(view, gsd_m)
        if near is None:
            return NoFix("too_small", "the view shows no ground that is near enough")
        nominal_m = NEAR_SHARE * math.sqrt(near.area_m2)
    levels = Levels.of(nominal_m / gsd_m, map_levels)

    @functools.cache
    def picture_at(level: int) -> View:
        return downsampled(view, gsd_m * 2**level)

    def rectified_at(level: int) -> RectifiedView:
        multiple = 2 ** max(0, levels.coarse - level)
        return rectify_footprint(picture_at(level), gsd_m=gsd_m * 2**level, multiple_px=multiple)

    rectified = rectified_at(levels.final)
    unit_px = 2**levels.final
    refused = check_footprint(rectified, unit_px, MIN_VIEW_PX)
    if refused is not None:
        return refused
    offset = rectified.offset_en_m / gsd_m
    side_px = math.sqrt(float(rectified.valid.sum())) * unit_px
    return PreparedView(
        picture_at,
        rectified_at,
        ViewTemplates(rectified.grey, rectified.valid, levels.final),
        levels,
        side_px,
        np.array([-offset[0], offset[1]]),
        pose_prior(telemetry, heading_known, camera.focal_std),
    )


def pose_prior(telemetry: Telemetry, heading_known: bool, focal_std: float = 0.0) -> PosePrior:
    """Expected heading and scale of a view, by its telemetry and its camera's `focal_std`."""
    yaw_std = _or_default(telemetry.yaw_std_deg, DEFAULT_YAW_STD_DEG)
    agl_std_m = telemetry.agl_std_m
    agl_std = None if agl_std_m is None else agl_std_m / telemetry.agl_m
    scale_std = math.hypot(_or_default(agl_std, DEFAULT_AGL_STD), focal_std)
    return PosePrior(
        math.radians(telemetry.yaw_deg) if heading_known else None,
        math.radians(min(max(yaw_std, MIN_YAW_STD_DEG), 90.0)),
        min(max(scale_std, MIN_AGL_STD), MAX_AGL_STD),
    )


def _or_default(value: float | None, default: float) -> float:
    return default if value is None or not math.isfinite(value) else value
