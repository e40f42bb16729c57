"""Calibration of confidence from the imagery of the map itself.

Views are cropped from the reference at random positions with simulated ageing: light, contrast,
blur, noise, heading and height errors, and up to two thirds of the image replaced by another
position. Mirrored views serve as negatives: no place is the mirror image of another. Both are
searched, and a logistic regression is fitted to the outcome. Where too few views are found, the
usual confidence is drawn to them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar

from orthonav.core.files import Progress
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.confidence import (
    DEFAULT_CHANCES,
    DEFAULT_SHIFT,
    TILE_FEATURES,
    Chances,
    LogisticConfidence,
    RegisteredConfidence,
    Scores,
    features_of,
    logit,
)
from orthonav.core.localize.prepared import PreparedMap
from orthonav.core.localize.search import Search
from orthonav.core.localize.tiles import TileMatcher
from orthonav.core.records import PRIOR_SIGMAS, NoFix, Prior, Telemetry, View
from orthonav.core.register.window import rotation
from orthonav.core.tiles.embed import ViewEmbedder


def changed(
    rng: np.random.Generator,
    grey: NDArray[np.uint8],
    other: NDArray[np.uint8],
    *,
    most_replaced: float = 0.75,
    most_mixed: float = 0.85,
) -> NDArray[np.uint8]:
    """`grey` (S, S) uint8 with the changes of years, `other` an image that is not on the map.

    `most_replaced`: largest share replaced by it; `most_mixed`: largest weight of its detail
    (0..1).
    """
    size = grey.shape[0]
    resized = np.asarray(cv2.resize(other, (size, size)), dtype=np.float32)
    own, own_broad = _detail(grey.astype(np.float32), size)
    foreign, foreign_broad = _detail(resized, size)
    mask = _smooth(rng, size, int(rng.integers(3, 12)))
    replaced = mask < np.quantile(mask, rng.uniform(0, most_replaced))
    gain = 0.35 + 0.9 * _smooth(rng, size, 6)
    turned = _smooth(rng, size, 5) > rng.uniform(0.55, 1.1)
    mixed = rng.uniform(0, most_mixed)
    detail = (1 - mixed) * own * np.where(turned, -gain, gain)
    # Flipped, so that replaced and mixed parts show different detail.
    detail = np.where(replaced, foreign, detail + mixed * foreign[::-1])
    light = np.where(replaced, foreign_broad, own_broad) + 40 * (_smooth(rng, size, 4) - 0.5)
    tone = np.power(np.clip(light + detail, 0, 255) / 255, rng.uniform(0.6, 1.7))
    blurred = np.asarray(cv2.GaussianBlur(tone, (0, 0), float(rng.uniform(0.3, 1.4))))
    exposed = blurred * 255 * rng.uniform(0.6, 1.25)
    noisy = exposed + rng.normal(0, rng.uniform(1, 6), grey.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def _detail(
    picture: NDArray[np.float32], size: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    broad = np.asarray(cv2.GaussianBlur(picture, (0, 0), size / 16), dtype=np.float32)
    return picture - broad, broad


def _smooth(rng: np.random.Generator, size: int, cells: int) -> NDArray[np.float32]:
    """A smooth random field (S, S) around 0.5, `cells` values across."""
    values = rng.random((cells, cells)).astype(np.float32)
    return np.asarray(cv2.resize(values, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)


CROPS = 192
"""Views searched by tile matching; seconds per map."""
ENOUGH_RIGHT = 10
"""Correct views, below which nothing is learnt from them."""


@dataclass(frozen=True)
class CalibrationParameters:
    slow_crops: int = 32  # views searched with representations that take minutes per view
    crop_tiles: float = 1.5  # width of crops in tiles: a rotated tile fits into it
    small_tiles: float = 2.5  # narrower sheets with a border of nodata have few such crops
    enough_crops: int = 48  # whole crops, below which others are used too ..
    min_valid: float = 0.9  # .. with at least this fraction of valid pixels
    heading_std_deg: float = 5.0  # errors of heading and height: those of the benchmarks
    scale_std: float = 0.05
    heading_step_deg: float = 6.0  # spacing of the headings that tile matching tries
    pasted_share: float = 0.25  # of replacements by another place of the map, not mirrored
    mirrored_weight: float = 0.25  # a flight sees fewer places outside the map than inside
    radius_strides: float = 0.75  # a fix is correct if its error is below this many strides
    floor_px: float = 0.6  # usual standard deviation per axis between two dates, and its limits
    floor_limits_px: tuple[float, float] = (0.25, 3.0)
    min_negatives: int = 5  # mirrored views from which the scores of chance are their medians
    usual_fine: float = 1.45  # prior of how one more level raises the score of a chance match ..
    usual_fine_views: float = 8.0  # .. and its weight
    whole_px: int = 6144
    searched_px: int = 4096
    """Maps larger than a square of the first are searched in a square of the second for each view:
    on a map of 50 x 5 km a full search took 7 GB and minutes per view, and too few views were found
    for a fit (4 of 24 on 10 x 5 km; 9 of 24 in the square)."""
    ridge: float = 3e-2  # weight of the usual bias of registered views
    tile_ridge: float = 1e-3  # only against weights without bound


CALIBRATION = CalibrationParameters()


@dataclass(frozen=True, eq=False)
class Crop:
    """Grey levels (S, S), and the pixel position of their centre on the sheet."""

    grey: NDArray[np.uint8]
    row_px: float
    col_px: float


@dataclass(frozen=True)
class TileCalibration:
    """`position_std_m`: standard deviation per axis of a correct fix."""

    confidence: LogisticConfidence
    position_std_m: float


class CropSampler:
    def __init__(self, tile_px: int, seed: int, sheet_px: float = math.inf) -> None:
        """`sheet_px`: shorter side of the sheet; on a small one crops are no larger than tiles."""
        self._rng = np.random.default_rng([seed, 1])
        self._tile_px = tile_px
        is_small = sheet_px < CALIBRATION.small_tiles * tile_px
        self.size_px = tile_px if is_small else round(tile_px * CALIBRATION.crop_tiles)
        self._whole: list[Crop] = []
        self._partial: list[Crop] = []

    def places(self, height: int, width: int, share: float) -> NDArray[np.intp]:
        """Random first pixels (row, col), (N, 2), of crops, drawn before any block is read."""
        size = self._crop_px(height, width)
        if size < self._tile_px:
            return np.zeros((0, 2), np.intp)
        drawn = [
            [self._rng.integers(0, height - size + 1), self._rng.integers(0, width - size + 1)]
            for _ in range(self._rng.poisson(2.0 * CROPS * share))
        ]
        return np.array(drawn, np.intp).reshape(-1, 2)

    def take(
        self,
        grey: NDArray[np.uint8],
        valid: NDArray[np.bool_],
        places: NDArray[np.intp],
        row_px: int,
        col_px: int,
    ) -> None:
        """Add the crops with contrast at `places` (N, 2) of a block whose first pixel is (row_px,
        col_px) of the sheet."""
        size = self._crop_px(*grey.shape)
        for row, col in places.tolist():
            part = np.s_[row : row + size, col : col + size]
            crop, inside = grey[part], valid[part]
            share = inside.mean()
            known = self._whole if share == 1 else self._partial
            if len(known) >= 2 * CROPS or share < CALIBRATION.min_valid or crop[inside].std() <= 1:
                continue
            filled = np.where(inside, crop, crop[inside].mean().round()).astype(np.uint8)
            known.append(Crop(filled, row_px + row + size / 2, col_px + col + size / 2))

    @property
    def crops(self) -> list[Crop]:
        missing = max(CALIBRATION.enough_crops - len(self._whole), 0)
        return self._whole + self._partial[:missing]

    def _crop_px(self, height: int, width: int) -> int:
        return min(height, width, self.size_px)


def calibrate(
    sampled: Sequence[Crop],
    tiles: TileMatcher,
    representation: Any,
    embedder: ViewEmbedder,
    progress: Progress,
    *,
    usual: LogisticConfidence | None,
    slow: bool = False,
) -> TileCalibration:
    """Search changed and mirrored crops on the new map. `usual`: confidence on other maps, if
    known."""
    grid = tiles.grid
    rng = np.random.default_rng([len(sampled), 2])
    most = min(CROPS, CALIBRATION.slow_crops) if slow else CROPS
    crops = [sampled[i] for i in rng.permutation(len(sampled))[:most]]
    features, errors, mirrored = [], [], []
    for done, crop in enumerate(crops):
        other = crops[int(rng.integers(len(crops)))].grey
        if rng.random() > CALIBRATION.pasted_share:
            other = other[:, ::-1]
        truth = grid.west_m + crop.col_px * grid.gsd_m, grid.north_m - crop.row_px * grid.gsd_m
        for mirror in (False, True):
            picture = crop.grey[:, ::-1] if mirror else crop.grey
            aged = changed_picture(rng, picture, other)
            match = tiles.match(_queries(rng, aged, grid, representation, embedder))
            features.append([match.evidence[name] for name in TILE_FEATURES])
            errors.append(tiles.centres_en_m[match.tile] + np.array(match.shift_en_m) - truth)
            mirrored.append(mirror)
        progress("calibrate", (done + 1) / len(crops))
    errors_en_m, is_mirrored = np.reshape(errors, (-1, 2)), np.array(mirrored, bool)
    near = np.hypot(*errors_en_m.T) <= CALIBRATION.radius_strides * grid.stride_m
    right = near & ~is_mirrored
    weight = np.where(is_mirrored, CALIBRATION.mirrored_weight, 1.0)
    evidence = np.reshape(np.array(features, float), (-1, len(TILE_FEATURES)))
    if right.sum() < 10:
        return TileCalibration(fit_few(evidence, right, weight, usual), grid.stride_m)
    confidence = LogisticConfidence(*fit_weights(evidence, right, weight))
    std_m = float(np.sqrt(np.mean(errors_en_m[right] ** 2)))
    return TileCalibration(confidence, max(std_m, grid.gsd_m))


def changed_picture(
    rng: np.random.Generator, grey: NDArray[np.uint8], other: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """`grey` (S, S) with simulated ageing: light, blur, noise, replaced parts."""
    size = grey.shape[0]
    other = np.asarray(cv2.resize(other, (size, size)), dtype=np.uint8)
    mask = _smooth(rng, size, 8)
    replaced = mask < np.quantile(mask, rng.uniform(0, 0.65))
    picture = np.where(replaced, other, grey).astype(np.float32) / 255
    picture = np.power(picture, rng.uniform(0.6, 1.7)) * rng.uniform(0.5, 1.3)
    blurred = np.asarray(cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.3, 1.4))))
    noisy = blurred * 255 + rng.normal(0, rng.uniform(1, 6), picture.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def _queries(
    rng: np.random.Generator,
    picture: NDArray[np.uint8],
    grid: TileGrid,
    representation: Any,
    embedder: ViewEmbedder,
) -> NDArray[np.float32]:
    """Embeddings (3, D) of the centre of an image at the headings that the localizer tries."""
    heading = rng.normal(0, CALIBRATION.heading_std_deg)
    scale = float(np.exp(rng.normal(0, CALIBRATION.scale_std)))
    size, middle = grid.tile_px, (picture.shape[0] - 1) / 2
    inside = np.ones(picture.shape, dtype=np.uint8)
    queries = []
    step_deg = CALIBRATION.heading_step_deg
    for step in (-step_deg, 0.0, step_deg):
        matrix = cv2.getRotationMatrix2D((middle, middle), heading + step, scale)
        matrix[:, 2] -= middle - (size - 1) / 2
        view = np.asarray(cv2.warpAffine(picture, matrix, (size, size)), dtype=np.uint8)
        valid = np.asarray(cv2.warpAffine(inside, matrix, (size, size)) > 0, dtype=np.bool_)
        queries.append(embedder.view(representation(view, valid), valid))
    return np.stack(queries)


@dataclass(frozen=True)
class RegistrationCalibration:
    """`floor_px`: lower bound of the reported standard deviation per axis."""

    confidence: RegisteredConfidence
    floor_px: float


def calibrate_registration(
    prepared: PreparedMap,
    crops: Sequence[Crop],
    other_dates: Sequence[Crop],
    views: int,
    seed: int,
    progress: Progress,
) -> RegistrationCalibration:
    """Locate at most `views` mirrored views, and as many of other dates; learn from the outcome."""
    rng = np.random.default_rng([seed, 3])
    order = rng.permutation(len(crops))
    later = [other_dates[i] for i in rng.permutation(len(other_dates))[:views]]
    mirrored = (later or [crops[i] for i in order])[:views]
    work = [(crop, False) for crop in later] + [(crop, True) for crop in mirrored]
    found: list[tuple[Scores, float, bool]] = []
    for done, (crop, mirror) in enumerate(work):
        picture = crop.grey
        if mirror:
            picture = np.ascontiguousarray(picture[:, ::-1])
        if not later:
            # The replacement is mirrored: unmirrored it would be found at its own position.
            replaced_by = crops[int(rng.integers(len(crops)))].grey[:, ::-1]
            picture = changed(rng, picture, replaced_by)
        view = _view(rng, picture, prepared.grid)
        search = Search.of(prepared, view, _prior(rng, prepared, crop))
        outcome = search if isinstance(search, NoFix) else search.run()
        if not isinstance(outcome, NoFix):
            pose = outcome.best.place.window_pose
            off_px = np.hypot(pose.x_px - crop.col_px, pose.y_px - crop.row_px)
            found.append((outcome.best.scores, float(off_px), mirror))
        progress("calibrate registration", (done + 1) / len(work))
    return _fitted(found, prepared.radius_m / prepared.grid.gsd_m)


def _fitted(
    found: Sequence[tuple[Scores, float, bool]], radius_px: float
) -> RegistrationCalibration:
    """From scores, error in pixels and whether it was mirrored, of each view that was placed."""
    scores, errors_px, is_mirrored = zip(*found, strict=True) if found else ((), (), ())
    negatives = [each for each, mirror in zip(scores, is_mirrored, strict=True) if mirror]
    chances = _chances(negatives)
    confidence, floor_px = RegisteredConfidence.usual(chances), CALIBRATION.floor_px
    right = ~np.array(is_mirrored, bool) & (np.array(errors_px, float) <= radius_px)
    if right.sum() >= ENOUGH_RIGHT:
        # From the median: Rayleigh's is 1.1774 standard deviations.
        spread = float(np.median(np.array(errors_px)[right])) / 1.1774
        low_px, high_px = CALIBRATION.floor_limits_px
        floor_px = min(max(spread, low_px), high_px)
        # Without a mirrored view nothing would show what a wrong place looks like.
        if negatives:
            confidence = fit_registered(scores, right, chances)
    return RegistrationCalibration(confidence, floor_px)


def _prior(rng: np.random.Generator, prepared: PreparedMap, crop: Crop) -> Prior | None:
    """On a large map, limits the search to a square with the crop in its middle half."""
    grid = prepared.grid
    if grid.height_px * grid.width_px <= CALIBRATION.whole_px**2:
        return None
    side_px = CALIBRATION.searched_px
    col, row = np.array([crop.col_px, crop.row_px]) + rng.uniform(-0.25, 0.25, 2) * side_px
    place = np.array([grid.west_m + col * grid.gsd_m, grid.north_m - row * grid.gsd_m])
    lat, lon = prepared.sheet.frame.latlon_from_en(place)
    return Prior(float(lat), float(lon), side_px / 2 * grid.gsd_m / PRIOR_SIGMAS)


def _view(rng: np.random.Generator, picture: NDArray[np.uint8], grid: TileGrid) -> View:
    """A vertical view of the middle of a picture, with errors of heading and height."""
    size = picture.shape[0]
    longest = min(grid.tile_px, int(size / 1.27))  # its diagonal fits into the picture
    width = max(16, round(longest * rng.uniform(0.55, 1.0)))
    height = max(12, round(width * 0.75))
    yaw_deg = rng.uniform(0, 360)
    linear = rotation(math.radians(yaw_deg))
    move = np.full(2, (size - 1) / 2) - linear @ [(width - 1) / 2, (height - 1) / 2]
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    matrix = np.column_stack([linear, move])
    view = cv2.warpAffine(picture, matrix, (width, height), flags=flags)
    focal_px = 1000.0  # any: the view has the resolution of the map
    agl_m = focal_px * grid.gsd_m
    reported_m = agl_m * max(0.5, 1 + rng.normal(0, CALIBRATION.scale_std))
    telemetry = Telemetry(
        time_ns=0,
        yaw_deg=yaw_deg + rng.normal(0, CALIBRATION.heading_std_deg),
        pitch_deg=0.0,
        roll_deg=0.0,
        agl_m=reported_m,
        yaw_std_deg=CALIBRATION.heading_std_deg,
        agl_std_m=CALIBRATION.scale_std * reported_m,
    )
    camera = Camera(width, height, focal_px, focal_px, width / 2, height / 2)
    return View(np.asarray(view, dtype=np.uint8), camera, telemetry)


def _chances(negatives: Sequence[Scores]) -> Chances:
    """A view whose mid and final level are one has the strength of one score, not of two."""
    if len(negatives) < CALIBRATION.min_negatives:
        return DEFAULT_CHANCES
    mid = _median(negatives, "mid_score")
    both = [each for each in negatives if math.isfinite(each.detail_ratio)]
    total = mid + DEFAULT_CHANCES.total - DEFAULT_CHANCES.mid
    if len(both) >= CALIBRATION.min_negatives:
        total = _median(both, "strength")
    return Chances(total, mid, _fine_chance(negatives, total))


def _fine_chance(scores: Sequence[Scores], total: float) -> float:
    """Score of a chance match with one more level, shrunk towards the usual value."""
    known = sum(math.isfinite(each.fine) for each in scores)
    usual = CALIBRATION.usual_fine * total
    if not known:
        return usual
    share = known / (known + CALIBRATION.usual_fine_views)
    return math.exp(share * math.log(_median(scores, "fine")) + (1 - share) * math.log(usual))


def _median(scores: Sequence[Scores], name: str) -> float:
    values = [value for each in scores if math.isfinite(value := getattr(each, name))]
    return max(float(np.median(values)), 1.0) if values else 40.0


def fit_registered(
    scores: Sequence[Scores], right: NDArray[np.bool_], chances: Chances
) -> RegisteredConfidence:
    """The usual confidence with its first bias fitted to views (N) and drawn to the usual one."""
    usual = RegisteredConfidence.usual(chances)
    features = [features_of(each, chances) for each in scores]

    def shifted(shift: float) -> RegisteredConfidence:
        return replace(usual, biases=(usual.biases[0] + shift, usual.biases[1]))

    def loss(shift: float) -> float:
        model = shifted(shift)
        said = np.clip([model.of(each) for each in features], 1e-9, 1 - 1e-9)
        return float(CALIBRATION.ridge * shift**2 - np.log(np.where(right, said, 1 - said)).mean())

    return shifted(float(minimize_scalar(loss, bounds=(-5.0, 5.0)).x))


def fit_few(
    features: NDArray[np.float64],
    right: NDArray[np.bool_],
    sample_weight: NDArray[np.float64],
    usual: LogisticConfidence | None,
) -> LogisticConfidence:
    """The `usual` confidence, its bias drawn to trials of which too few came out right for a fit.

    Without one, or without any trial, the fraction of right trials, whatever the evidence.
    """
    if usual is None or len(features) == 0:
        share = (sample_weight @ right + 0.5) / (sample_weight.sum() + 5.0)
        bias = logit(float(share), CALIBRATION.tile_ridge)
        return LogisticConfidence(bias, (0.0,) * len(TILE_FEATURES))
    known = features @ np.array(usual.weights) + usual.bias
    sign = np.where(right, 1.0, -1.0)

    def loss(shift: float) -> float:
        off = sample_weight @ np.logaddexp(0, -sign * (known + shift))
        return float(off + (shift / DEFAULT_SHIFT) ** 2 / 2)

    shift = minimize_scalar(loss, bounds=(-10.0, 10.0)).x
    return LogisticConfidence(usual.bias + float(shift), usual.weights)


def fit_weights(
    features: NDArray[np.float64],
    right: NDArray[np.bool_],
    sample_weight: NDArray[np.float64],
    ridge: float = CALIBRATION.tile_ridge,
) -> tuple[float, tuple[float, ...]]:
    """Bias and weights (at least 0) of a logistic regression with a slight ridge.

    `features` (N, F) are standardized inside; the result applies to raw ones.
    """
    mean, std = features.mean(axis=0), features.std(axis=0) + 1e-9
    scaled = (features - mean) / std
    sign = np.where(right, 1.0, -1.0)
    total = sample_weight.sum()

    def loss(parameters: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        logit = parameters[0] + scaled @ parameters[1:]
        value = sample_weight @ np.logaddexp(0, -sign * logit) / total
        slope = -sign * sample_weight / (1 + np.exp(np.clip(sign * logit, -60, 60))) / total
        gradient = np.concatenate([[slope.sum()], scaled.T @ slope])
        gradient[1:] += 2 * ridge * parameters[1:]
        value += ridge * (parameters[1:] ** 2).sum()
        return float(value), gradient

    bounds = [(None, None)] + [(0.0, None)] * features.shape[1]
    found = minimize(
        loss, np.zeros(features.shape[1] + 1), jac=True, bounds=bounds, method="L-BFGS-B"
    ).x
    weights = found[1:] / std
    return float(found[0] - weights @ mean), tuple(float(weight) for weight in weights)
