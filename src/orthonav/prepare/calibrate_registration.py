"""Calibration of the confidence of registered views on a new map.

Views are cropped from the reference at random positions, sizes, headings and heights with simulated
ageing (`change`), or from another date of the same area if one is given. Mirrored views serve as
negatives: no place is the mirror image of another. All are located by the localizer that flies, and
a logistic regression is fitted to the outcome.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.confidence.registered import (
    USUAL_CHANCES,
    USUAL_CONFIDENCE,
    Chances,
    RegisteredConfidence,
    fit_registered,
)
from orthonav.files import Progress
from orthonav.geo.camera import Camera
from orthonav.geo.grid import TileGrid
from orthonav.localizer.registration import RegistrationLocalizer
from orthonav.prepare.calibrate import Crop
from orthonav.prepare.change import changed
from orthonav.records import PRIOR_SIGMAS, NoFix, Prior, Telemetry, View
from orthonav.register.pose import rotation

YAW_STD_DEG = 5.0
AGL_STD = 0.05
"""Errors of heading and height (a share): those of the benchmarks."""
FOCAL_PX = 1000.0
"""Any value: views have the resolution of the map, and only the ratio to the height matters."""
SIDES = (0.55, 1.0)
"""Long side of a view, from and to, in tiles; the short side is three quarters of it."""
ENOUGH_RIGHT = 10
"""Fewest correct views that a confidence is fitted to: of fewer, the evidence hardly varies. With
fewer the usual confidence is used, with the scores of chance measured on this map."""
ENOUGH_VIEWS = 12
"""Where fewer than `ENOUGH_RIGHT` views are right, views are added until so many are."""
MORE_VIEWS = 3
"""Additional views at most, as a multiple of the requested number."""
FLOOR_PX = 0.6
"""Usual standard deviation per axis, in pixels, between orthophotos of two dates."""
FLOOR_LIMITS_PX = (0.25, 3.0)
MIRRORED_WEIGHT = 1.0
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

    `floor_px`: lower bound of the reported standard deviation per axis, pixels. `right`: correct
    views that the confidence was learnt from.
    """

    confidence: RegisteredConfidence
    floor_px: float
    right: int

    @property
    def is_usual(self) -> bool:
        """Whether too few views were right for a confidence of the map's own."""
        return self.right < ENOUGH_RIGHT


@dataclass(frozen=True, eq=False)
class _Outcome:
    evidence: Mapping[str, float]
    error_px: NDArray[np.float64]
    mirrored: bool
    other_date: bool

    def is_right(self, radius_px: float) -> bool:
        return not self.mirrored and float(np.hypot(*self.error_px)) <= radius_px


def calibrate_registration(
    localizer: RegistrationLocalizer,
    crops: Sequence[Crop],
    other_dates: Sequence[Crop],
    views: int,
    seed: int,
    progress: Progress,
) -> RegistrationCalibration:
    """Locate changed, mirrored and other-date views and fit the confidence to the outcome."""
    rng = np.random.default_rng([seed, 3])
    order = rng.permutation(len(crops))
    chosen = [crops[i] for i in order[:views]]
    later = [other_dates[i] for i in rng.permutation(len(other_dates))[:views]]
    work = [(crop, False, False) for crop in chosen] + [(crop, False, True) for crop in later]
    work += [(crop, True, False) for crop in (later or chosen)[: views // 2]]
    radius_px = localizer.radius_m / localizer.grid.gsd_m
    outcomes: list[_Outcome] = []

    def place(crop: Crop, mirror: bool, other_date: bool) -> None:
        # The replacement is mirrored: unmirrored it would be found at its own position.
        negative = crops[int(rng.integers(len(crops)))].grey[:, ::-1]
        outcome = _placed(rng, localizer, crop, negative, mirror, other_date)
        if outcome is not None:
            outcomes.append(outcome)

    for done, each in enumerate(work):
        place(*each)
        progress("calibrate registration", (done + 1) / len(work))
    # Few views are correct on a large map: add some, rather than give up on a confidence.
    wanted = ENOUGH_VIEWS if _right(outcomes, radius_px) < ENOUGH_RIGHT else 0
    spare = order[views : (1 + MORE_VIEWS) * views] if views >= ENOUGH_RIGHT else order[:0]
    for index in spare:
        if _right(outcomes, radius_px) >= wanted:
            break
        place(crops[index], False, False)
    return _fitted(outcomes, radius_px)


def _right(outcomes: Sequence[_Outcome], radius_px: float) -> int:
    return sum(each.is_right(radius_px) for each in outcomes)


def _placed(
    rng: np.random.Generator,
    localizer: RegistrationLocalizer,
    crop: Crop,
    negative: NDArray[np.uint8],
    mirror: bool,
    other_date: bool,
) -> _Outcome | None:
    """Outcome of locating one view generated from a crop; None if there is no fix."""
    picture = np.ascontiguousarray(crop.grey[:, ::-1]) if mirror else crop.grey
    if not other_date:
        picture = changed(rng, picture, negative)
    view = _view(rng, picture, localizer.grid)
    seen = localizer.register(view, _prior(rng, localizer, crop))
    if isinstance(seen, NoFix) or isinstance(seen.found, NoFix):
        return None
    best = seen.found
    error = np.array([best.placed.pose.x_px - crop.col_px, best.placed.pose.y_px - crop.row_px])
    return _Outcome(best.evidence(), error, mirror, other_date)


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
    if not outcomes:
        return RegistrationCalibration(USUAL_CONFIDENCE, FLOOR_PX, 0)
    mirrored = np.array([each.mirrored for each in outcomes])
    errors = np.stack([each.error_px for each in outcomes])
    right = (np.hypot(*errors.T) <= radius_px) & ~mirrored
    later = right & np.array([each.other_date for each in outcomes])
    floor_px = FLOOR_PX
    if later.sum() >= ENOUGH_RIGHT:
        # From the median: Rayleigh's is 1.1774 standard deviations.
        spread = float(np.median(np.hypot(*errors[later].T))) / 1.1774
        floor_px = min(max(spread, FLOOR_LIMITS_PX[0]), FLOOR_LIMITS_PX[1])
    evidence = [each.evidence for each in outcomes]
    negatives = [each for each, known in zip(evidence, mirrored, strict=True) if known]
    chances = _chances(negatives) if len(negatives) >= MIN_NEGATIVES else USUAL_CHANCES
    confidence = replace(USUAL_CONFIDENCE, chances=chances)
    if right.sum() >= ENOUGH_RIGHT:
        weight = np.where(mirrored, MIRRORED_WEIGHT, 1.0)
        confidence = fit_registered(evidence, right, weight, chances)
    return RegistrationCalibration(confidence, floor_px, int(right.sum()))


def _chances(negatives: Sequence[Mapping[str, float]]) -> Chances:
    """The scores of chance by the evidence of mirrored views."""
    total, look = _median(negatives, "strength"), _median(negatives, "look")
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
