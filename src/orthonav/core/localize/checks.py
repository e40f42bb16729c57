"""Views that cannot be placed are refused before any search, each by a `NoFix` with its reason."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera
from orthonav.core.localize.rectify import RectifiedView, off_nadir_deg
from orthonav.core.records import NoFix, Telemetry, View

MAX_TILT_DEG = 65.0
MIN_SIDE_PX = 32
MIN_VIEW_PX = 24.0
"""Narrower views (pixels of the map across) are refused: a template of 24 px is a sixth of the size
that views are finished at (docs/decisions/registration.md)."""
MIN_TILT_COS = 0.5
"""Beyond a tilt of 60 deg the footprint is not expected to grow: it is cut off (`rectify`)."""
MAX_COARSER = 4.0
DARK_LEVEL = 16.0
BRIGHT_LEVEL = 250.0
MIN_STD = 3.0
_SAMPLE_STEP_PX = 8


def check_view(view: View, gsd_m: float, heading_known: bool) -> NoFix | None:
    """Why a view cannot be placed on a map of resolution `gsd_m`; None if it can be tried."""
    refused = check_telemetry(view.telemetry, view.camera, gsd_m, heading_known)
    return refused or check_picture(view.grey)


def check_telemetry(
    telemetry: Telemetry, camera: Camera, gsd_m: float | None, heading_known: bool
) -> NoFix | None:
    """Why a view with this telemetry cannot be rectified to `gsd_m`; None if it can.

    Without `gsd_m` its size beside a map is not checked.
    """
    missing = [name for name in telemetry.missing() if heading_known or name != "yaw_deg"]
    if missing:
        return NoFix("missing_telemetry", f"not a number: {', '.join(missing)}")
    if telemetry.agl_m <= 0:
        return NoFix("bad_height", f"height above ground is {telemetry.agl_m:.1f} m")
    tilt_deg = off_nadir_deg(telemetry)
    if tilt_deg > MAX_TILT_DEG:
        return NoFix(
            "extreme_tilt",
            f"camera tilts {tilt_deg:.0f} deg, at most {MAX_TILT_DEG:.0f} can be used; pitch and "
            "roll are 0 for a camera that looks down",
        )
    if min(camera.width_px, camera.height_px) < MIN_SIDE_PX:
        return NoFix("too_small", f"view is {camera.width_px} x {camera.height_px} px")
    if gsd_m is None:
        return None
    side_px = footprint_side_m(telemetry, camera) / gsd_m
    if side_px < MIN_VIEW_PX:
        return _too_small(side_px, MIN_VIEW_PX, f"{telemetry.agl_m:.0f} m above ground, ")
    coarser = camera.gsd_m(telemetry.agl_m) / gsd_m
    if coarser > MAX_COARSER:
        return NoFix("too_coarse", f"a pixel of the view covers {coarser:.3g} pixels of the map")
    return None


def footprint_side_m(telemetry: Telemetry, camera: Camera) -> float:
    """Root of the area of flat ground that a view shows, as it is expected from the telemetry."""
    tilt = math.cos(math.radians(telemetry.pitch_deg)) * math.cos(math.radians(telemetry.roll_deg))
    # The area seen grows with the inverse cube of the cosine of the tilt.
    across, along = camera.extent
    return telemetry.agl_m * math.sqrt(across * along / max(tilt, MIN_TILT_COS) ** 3)


def check_picture(grey: NDArray[np.uint8]) -> NoFix | None:
    """Why a view (H, W) shows nothing: too dark, too bright, blank; None if it shows something."""
    sample = grey[::_SAMPLE_STEP_PX, ::_SAMPLE_STEP_PX]
    counts = np.bincount(sample.reshape(-1), minlength=256)
    low, high = (_percentile(counts, percent) for percent in (1, 99))
    levels, size = np.arange(256), int(counts.sum())
    mean = float(counts @ levels) / size
    std = math.sqrt(max(float(counts @ levels**2) / size - mean**2, 0.0))
    if high < DARK_LEVEL:
        return NoFix("too_dark", f"99 % of the view is darker than {high:.0f} of 255")
    if low > BRIGHT_LEVEL:
        return NoFix("too_bright", f"99 % of the view is brighter than {low:.0f} of 255")
    if std < MIN_STD:
        return NoFix("blank", f"grey levels differ by {std:.1f} of 255 only (standard deviation)")
    return None


def _percentile(counts: NDArray[np.intp], percent: float) -> float:
    """As `np.percentile` of the levels that were counted, in a tenth of the time."""
    upto = np.cumsum(counts)
    at = percent / 100 * (int(upto[-1]) - 1)
    below, above = np.searchsorted(upto, [math.floor(at), math.ceil(at)], side="right").tolist()
    return float(below + (at - math.floor(at)) * (above - below))


def check_rectified(view: RectifiedView, min_valid_share: float) -> NoFix | None:
    """Why too little of a tile is seen; None if enough is."""
    share = float(view.valid.mean())
    if share < min_valid_share or share == 0:
        return NoFix(
            "too_small", f"view covers {share:.0%} of a tile, {min_valid_share:.0%} are needed"
        )
    if _is_uniform(view):
        return NoFix("blank", "the part of the view that would be compared is uniform")
    return None


def check_footprint(view: RectifiedView, pixel: float, min_side_px: float) -> NoFix | None:
    """Why a rectified footprint shows too little; None if enough.

    `pixel` is the size of its pixels in pixels of the map, `min_side_px` the least side, in those.
    """
    side = math.sqrt(cv2.countNonZero(view.valid.view(np.uint8))) * pixel
    if side < min_side_px:
        return _too_small(side, min_side_px)
    if _is_uniform(view):
        return NoFix("blank", "the part of the view that would be compared is uniform")
    return None


def _too_small(side_px: float, least_px: float, where: str = "") -> NoFix:
    detail = f"{where}view covers {side_px:.0f} pixels of the map across, {least_px:.0f} needed"
    return NoFix("too_small", detail)


def _is_uniform(view: RectifiedView) -> bool:
    _, std = cv2.meanStdDev(view.grey, mask=view.valid.view(np.uint8))
    return float(std[0, 0]) < MIN_STD / 2
