"""A view checked and rectified with its own heading up. What cannot be placed becomes a `NoFix`."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.core.localize.rectify import (
    RectifiedView,
    downsampled,
    is_oblique,
    near_part,
    off_nadir_deg,
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
from orthonav.core.register.template import Levels, ViewTemplates
from orthonav.core.register.window import DirectionPrior


@dataclass(frozen=True)
class ViewLimits:
    """What a view must be to be searched for (docs/decisions/registration.md)."""

    max_tilt_deg: float = 65.0
    min_side_px: int = 32  # of the picture
    min_view_px: float = 24.0
    """Of the map: a sixth of the size that views are finished at."""
    max_coarser: float = 4.0  # a pixel of the view, in pixels of the map
    dark: float = 16.0
    bright: float = 250.0
    """Grey levels that 1 % of the view must exceed, or stay below."""
    min_std: float = 3.0  # of the grey levels
    min_agl_std: float = 0.03  # of the log scale searched, whatever is reported
    max_agl_std: float = 0.15
    """Three are scales of 0.64 to 1.57: between these chance was measured to be alike."""
    near_share: float = 0.6
    """A part far off nadir is judged as one so many times smaller (docs/terrain.md)."""


LIMITS = ViewLimits()


def check_view(view: View, gsd_m: float, heading_known: bool) -> NoFix | None:
    refused = check_telemetry(view.telemetry, view.camera, gsd_m, heading_known)
    return refused or check_picture(view.grey, view.camera.mask)


def check_telemetry(
    telemetry: Telemetry, camera: Camera, gsd_m: float | None, heading_known: bool
) -> NoFix | None:
    """Without `gsd_m` its size beside a map is not checked."""
    missing = [name for name in telemetry.missing() if heading_known or name != "yaw_deg"]
    if missing:
        names = ", ".join(missing).replace("yaw_deg", "heading_deg (yaw_deg)")
        return NoFix("missing_telemetry", f"not a number: {names}")
    if telemetry.agl_m <= 0:
        return NoFix("bad_height", f"height above ground is {telemetry.agl_m:.1f} m")
    tilt_deg = off_nadir_deg(telemetry)
    if tilt_deg > LIMITS.max_tilt_deg:
        return NoFix(
            "extreme_tilt",
            f"camera tilts {tilt_deg:.0f} deg, at most {LIMITS.max_tilt_deg:.0f} can be used; "
            "pitch and roll are 0 for a camera that looks down",
        )
    if min(camera.width_px, camera.height_px) < LIMITS.min_side_px:
        return NoFix("too_small", f"view is {camera.width_px} x {camera.height_px} px")
    if gsd_m is None:
        return None
    side_px = footprint_side_m(telemetry, camera) / gsd_m
    if side_px < LIMITS.min_view_px:
        return _too_small(side_px, LIMITS.min_view_px, f"{telemetry.agl_m:.0f} m above ground, ")
    coarser = camera.gsd_m(telemetry.agl_m) / gsd_m
    if coarser > LIMITS.max_coarser:
        return NoFix("too_coarse", f"a pixel of the view covers {coarser:.3g} pixels of the map")
    return None


def footprint_side_m(telemetry: Telemetry, camera: Camera) -> float:
    """Root of the area of flat ground expected from the telemetry."""
    tilt = math.cos(math.radians(telemetry.pitch_deg)) * math.cos(math.radians(telemetry.roll_deg))
    # The area seen grows with the inverse cube of the cosine of the tilt; beyond 60 deg the
    # footprint is cut off.
    across, along = camera.extent
    return telemetry.agl_m * math.sqrt(across * along / max(tilt, 0.5) ** 3)


def check_picture(grey: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None) -> NoFix | None:
    """Too dark, too bright, blank, where the mask of the camera shows ground?"""
    sample = grey[::8, ::8]
    if mask is not None:
        sample = sample[mask[::8, ::8] > 0]
        if sample.size == 0:
            return NoFix("blank", "the mask of the camera leaves too little of the view")
    (low, high), std = np.percentile(sample, (1, 99)), float(sample.std())
    if high < LIMITS.dark:
        return NoFix("too_dark", f"99 % of the view is {high:.0f} of 255 or darker")
    if low > LIMITS.bright:
        return NoFix("too_bright", f"99 % of the view is {low:.0f} of 255 or brighter")
    if std < LIMITS.min_std:
        return NoFix("blank", f"grey levels differ by {std:.1f} of 255 only (standard deviation)")
    return None


def check_rectified(view: RectifiedView, min_valid_share: float) -> NoFix | None:
    share = float(view.valid.mean())
    if share < min_valid_share or share == 0:
        return NoFix(
            "too_small", f"view covers {share:.0%} of a tile, {min_valid_share:.0%} are needed"
        )
    return _check_contrast(view)


def check_footprint(view: RectifiedView, pixel: float, min_side_px: float) -> NoFix | None:
    """`pixel`: size of its pixels in pixels of the map, the unit of `min_side_px`."""
    side = math.sqrt(cv2.countNonZero(view.valid.view(np.uint8))) * pixel
    return _too_small(side, min_side_px) if side < min_side_px else _check_contrast(view)


def _too_small(side_px: float, least_px: float, where: str = "") -> NoFix:
    detail = f"{where}view covers {side_px:.0f} pixels of the map across, {least_px:.0f} needed"
    return NoFix("too_small", detail)


def _check_contrast(view: RectifiedView) -> NoFix | None:
    _, std = cv2.meanStdDev(view.grey, mask=view.valid.view(np.uint8))
    if float(std[0, 0]) < LIMITS.min_std / 2:
        return NoFix("blank", "the part of the view that would be compared is uniform")
    return None


@dataclass(frozen=True, eq=False)
class PreparedView:
    """A view made ready for registration. `side_px`: root of the area seen, `camera_px` (2,): of
    the camera from the middle of the view, right and down; both in pixels of level 0."""

    view: View
    gsd_m: float
    levels: Levels
    templates: ViewTemplates
    side_px: float
    camera_px: NDArray[np.float64]
    prior: DirectionPrior
    _pictures: dict[int, View]

    @property
    def telemetry(self) -> Telemetry:
        return self.view.telemetry

    def picture_at(self, level: int) -> View:
        """Averaged towards the resolution of a level, once."""
        if level not in self._pictures:
            self._pictures[level] = downsampled(self.view, self.gsd_m * 2**level)
        return self._pictures[level]

    def by_gradients(self) -> "PreparedView":
        """The same, compared without its grey levels."""
        return replace(self, templates=self.templates.weighing_grey(0.0))

    def rectified_at(self, level: int) -> RectifiedView:
        return _rectified(self.picture_at(level), self.gsd_m, self.levels, level)


def prepare(
    view: View, gsd_m: float, map_levels: int, heading_known: bool, *, finer: bool = False
) -> PreparedView | NoFix:
    """`gsd_m`: of level 0 of the map; `finer`: as of `Levels.of`."""
    camera, telemetry = view.camera, view.telemetry
    nominal_m = footprint_side_m(telemetry, camera)
    if is_oblique(view):
        near = near_part(view, gsd_m)
        if near is None:
            return NoFix("too_small", "the view shows no ground that is near enough")
        nominal_m = LIMITS.near_share * math.sqrt(near.area_m2)
    levels = Levels.of(nominal_m / gsd_m, map_levels, finer=finer)
    unit_px = 2**levels.final
    picture = downsampled(view, gsd_m * unit_px)
    rectified = _rectified(picture, gsd_m, levels, levels.final)
    refused = check_footprint(rectified, unit_px, LIMITS.min_view_px)
    if refused is not None:
        return refused
    offset = rectified.offset_en_m / gsd_m
    return PreparedView(
        view,
        gsd_m,
        levels,
        ViewTemplates(rectified.grey, rectified.valid, levels.final),
        math.sqrt(float(rectified.valid.sum())) * unit_px,
        np.array([-offset[0], offset[1]]),
        pose_prior(telemetry, heading_known, camera.focal_std),
        {levels.final: picture},
    )


def _rectified(picture: View, gsd_m: float, levels: Levels, level: int) -> RectifiedView:
    """Its sides are whole pixels of the coarse level."""
    multiple = 2 ** max(0, levels.coarse - level)
    return rectify_footprint(picture, gsd_m=gsd_m * 2**level, multiple_px=multiple)


def pose_prior(telemetry: Telemetry, heading_known: bool, focal_std: float = 0.0) -> DirectionPrior:
    yaw_std = _or_default(telemetry.yaw_std_deg, DEFAULT_YAW_STD_DEG)
    agl_std_m = telemetry.agl_std_m
    agl_std = None if agl_std_m is None else agl_std_m / telemetry.agl_m
    scale_std = math.hypot(_or_default(agl_std, DEFAULT_AGL_STD), focal_std)
    return DirectionPrior(
        math.radians(telemetry.yaw_deg) if heading_known else None,
        math.radians(min(max(yaw_std, MIN_YAW_STD_DEG), 90.0)),
        min(max(scale_std, LIMITS.min_agl_std), LIMITS.max_agl_std),
    )


def _or_default(value: float | None, default: float) -> float:
    return default if value is None or not math.isfinite(value) else value
