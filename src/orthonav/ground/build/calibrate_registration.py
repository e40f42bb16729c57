"""Calibration of registration on a new map: the scores of chance, and how well dates agree.

Mirrored views of the map, aged by simulation (`change`), show no place of it: the scores that they
reach are those of chance. With another date of the same area, views of it show how far two dates
are displaced, and the usual confidence is drawn to them. All views are located by the localizer
that flies, at random sizes, headings and heights.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.files import Progress
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.registered import (
    USUAL_CHANCES,
    Chances,
    RegisteredConfidence,
    fit_registered,
)
from orthonav.core.localize.registration import RegistrationLocalizer
from orthonav.core.records import PRIOR_SIGMAS, NoFix, Prior, Telemetry, View
from orthonav.core.register.pose import rotation
from orthonav.ground.build.calibrate import Crop
from orthonav.ground.build.change import changed

YAW_STD_DEG = 5.0
AGL_STD = 0.05
"""Errors of heading and height (a share): those of the benchmarks."""
FOCAL_PX = 1000.0
"""Any value: views have the resolution of the map, and only the ratio to the height matters."""
SIDES = (0.55, 1.0)
"""Long side of a view, from and to, in tiles; the short side is three quarters of it."""
ENOUGH_RIGHT = 10
"""Fewest correct views of another date that anything is learnt from."""
FLOOR_PX = 0.6
"""Usual standard deviation per axis, in pixels, between orthophotos of two dates."""
FLOOR_LIMITS_PX = (0.25, 3.0)
MIN_NEGATIVES = 5
"""Mirrored views from which on the scores of chance are their medians."""
WHOLE_PX, SEARCHED_PX = 6144, 4096
"""Maps larger than a square of the first are searched in a square of the second for each view: on
a map of 50 x 5 km a full search took 7 GB and minutes per view, and too few views were found for a
fit (4 of 24 on 10 x 5 km; 9 of 24 in the square)."""
FALLBACK_CHANCE = 40.0
"""Score of a chance match if no negative has one."""
USUAL_FINE, USUAL_FINE_VIEWS = 1.45, 8.0
"""Prior of the ratio by which one more level raises the score of a chance match, and its weight in
views."""


@dataclass(frozen=True)
class RegistrationCalibration:
    """Calibration of registration.

    `floor_px`: lower bound of the reported standard deviation per axis, pixels.
    """

    confidence: RegisteredConfidence
    floor_px: float


@dataclass(frozen=True, eq=False)
class _Outcome:
    evidence: Mapping[str, float]
    error_px: NDArray[np.float64]
    mirrored: bool


def calibrate_registration(
    localizer: RegistrationLocalizer,
    crops: Sequence[Crop],
    other_dates: Sequence[Crop],
    views: int,
    seed: int,
    progress: Progress,
) -> RegistrationCalibration:
    """Locate mirrored views and views of other dates, and learn from the outcome.

    `crops` and `other_dates` are crops of the map and of other dates of its area. At most `views`
    mirrored views are located, and as many of other dates.
    """
    rng = np.random.default_rng([seed, 3])
    order = rng.permutation(len(crops))
    later = [other_dates[i] for i in rng.permutation(len(other_dates))[:views]]
    mirrored = (later or [crops[i] for i in order])[:views]
    work = [(crop, False) for crop in later] + [(crop, True) for crop in mirrored]
    outcomes: list[_Outcome] = []
    for done, (crop, mirror) in enumerate(work):
        picture = crop.grey
        if mirror:
            picture = np.ascontiguousarray(picture[:, ::-1])
        if not later:
            # The replacement is mirrored: unmirrored it would be found at its own position.
            replaced_by = crops[int(rng.integers(len(crops)))].grey[:, ::-1]
            picture = changed(rng, picture, replaced_by)
        outcome = _placed(rng, localizer, crop, picture, mirror)
        if outcome is not None:
            outcomes.append(outcome)
        progress("calibrate registration", (done + 1) / len(work))
    return _fitted(outcomes, localizer.radius_m / localizer.grid.gsd_m)


def _placed(
    rng: np.random.Generator,
    localizer: RegistrationLocalizer,
    crop: Crop,
    picture: NDArray[np.uint8],
    mirror: bool,
) -> _Outcome | None:
    """Outcome of locating one view of the picture of a crop; None if there is no fix."""
    view = _view(rng, picture, localizer.grid)
    seen = localizer.register(view, _prior(rng, localizer, crop))
    if isinstance(seen, NoFix) or isinstance(seen.found, NoFix):
        return None
    best = seen.found
    error = np.array([best.placed.pose.x_px - crop.col_px, best.placed.pose.y_px - crop.row_px])
    return _Outcome(best.evidence(), error, mirror)


def _prior(rng: np.random.Generator, localizer: RegistrationLocalizer, crop: Crop) -> Prior | None:
    """Prior that limits the search on a large map to a square with the crop in its middle half.

    None searches the whole map.
    """
    grid = localizer.grid
    if grid.height_px * grid.width_px <= WHOLE_PX**2:
        return None
    col, row = np.array([crop.col_px, crop.row_px]) + rng.uniform(-0.25, 0.25, 2) * SEARCHED_PX
    place = np.array([grid.west_m + col * grid.gsd_m, grid.north_m - row * grid.gsd_m])
    lat, lon = localizer.sheet.frame.latlon_from_en(place)
    return Prior(float(lat), float(lon), SEARCHED_PX / 2 * grid.gsd_m / PRIOR_SIGMAS)


def _view(rng: np.random.Generator, picture: NDArray[np.uint8], grid: TileGrid) -> View:
    """A vertical view of the middle of a picture, with errors of heading and height."""
    size = picture.shape[0]
    longest = min(grid.tile_px, int(size / 1.27))  # its diagonal fits into the picture
    width = max(16, round(longest * rng.uniform(*SIDES)))
    height = max(12, round(width * 0.75))
    yaw_deg = rng.uniform(0, 360)
    linear = rotation(math.radians(yaw_deg))
    move = np.full(2, (size - 1) / 2) - linear @ [(width - 1) / 2, (height - 1) / 2]
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    matrix = np.column_stack([linear, move])
    view = cv2.warpAffine(picture, matrix, (width, height), flags=flags)
    agl_m = FOCAL_PX * grid.gsd_m
    reported_m = agl_m * max(0.5, 1 + rng.normal(0, AGL_STD))
    telemetry = Telemetry(
        time_ns=0,
        yaw_deg=yaw_deg + rng.normal(0, YAW_STD_DEG),
        pitch_deg=0.0,
        roll_deg=0.0,
        agl_m=reported_m,
        yaw_std_deg=YAW_STD_DEG,
        agl_std_m=AGL_STD * reported_m,
    )
    camera = Camera(width, height, FOCAL_PX, FOCAL_PX, width / 2, height / 2)
    return View(np.asarray(view, dtype=np.uint8), camera, telemetry)


def _fitted(outcomes: Sequence[_Outcome], radius_px: float) -> RegistrationCalibration:
    """The confidence of errors below a radius, and the floor from views of other dates."""
    negatives = [each.evidence for each in outcomes if each.mirrored]
    chances = _chances(negatives) if len(negatives) >= MIN_NEGATIVES else USUAL_CHANCES
    confidence, floor_px = RegisteredConfidence.usual(chances), FLOOR_PX
    errors_px = np.array([np.hypot(*each.error_px) for each in outcomes])
    mirrored = np.array([each.mirrored for each in outcomes], np.bool_)
    right = ~mirrored & (errors_px <= radius_px)
    if right.sum() >= ENOUGH_RIGHT:
        # From the median: Rayleigh's is 1.1774 standard deviations.
        spread = float(np.median(errors_px[right])) / 1.1774
        floor_px = min(max(spread, FLOOR_LIMITS_PX[0]), FLOOR_LIMITS_PX[1])
        # Without a mirrored view nothing would show what a wrong place looks like.
        if negatives:
            confidence = fit_registered([each.evidence for each in outcomes], right, chances)
    return RegistrationCalibration(confidence, floor_px)


def _chances(negatives: Sequence[Mapping[str, float]]) -> Chances:
    """The scores of chance by the evidence of mirrored views.

    The strength of a view that is judged and finished at one level is the sum of one score, not of
    two: with small tiles most views are such, and say nothing of the sum.
    """
    look = _median(negatives, "look")
    both = [each for each in negatives if math.isfinite(each["detail_ratio"])]
    total = look + USUAL_CHANCES.total - USUAL_CHANCES.look
    if len(both) >= MIN_NEGATIVES:
        total = _median(both, "strength")
    return Chances(total, look, _fine_chance(negatives, total))


def _fine_chance(evidence: Sequence[Mapping[str, float]], total: float) -> float:
    """Score of a chance match with one more level, shrunk towards the usual value."""
    known = sum(math.isfinite(each["fine"]) for each in evidence)
    usual = USUAL_FINE * total
    if not known:
        return usual
    share = known / (known + USUAL_FINE_VIEWS)
    return math.exp(share * math.log(_median(evidence, "fine")) + (1 - share) * math.log(usual))


def _median(evidence: Sequence[Mapping[str, float]], name: str) -> float:
    """Median of one number of the evidence over the views that have it, at least 1."""
    values = [each[name] for each in evidence if math.isfinite(each[name])]
    return max(float(np.median(values)), 1.0) if values else FALLBACK_CHANCE
