"""Calibration of the confidence of tile matches from the imagery of the map itself.

Views are cropped from the reference at random positions with simulated ageing: light, contrast,
blur, noise, heading and height errors, and up to two thirds of the image replaced by another
position. Mirrored views serve as negatives: no place is the mirror image of another. Both are
searched, and a logistic regression is fitted to the outcome. The result is conservative rather than
exact, because no second date is used. Where too few views are found, the usual confidence is drawn
to them.
"""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.files import Progress
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.logistic import FEATURES, LogisticConfidence, fit_few, fit_logistic
from orthonav.core.localize.match import TileMatcher
from orthonav.core.tiles.contract import ViewEmbedder

CROPS = 192
"""Views searched; seconds per map."""
SLOW_CROPS = 32
"""The same for representations that take minutes per view."""
CROP_TILES = 1.5
"""Width of a crop in tiles: a rotated tile fits into it."""
SMALL_TILES = 2.5
"""Sheets less wide, in tiles, whose border is not all imagery, have few crops of that width."""
HEADING_STD_DEG = 5.0
SCALE_STD = 0.05
"""Errors of heading and height: those of the benchmarks."""
MAX_REPLACED = 0.65
MIRRORED_WEIGHT = 0.25
"""Weight of a mirrored view; a flight sees fewer places outside the map than inside."""
PASTED_SHARE = 0.25
"""Share of replacements by another position of the map; the others are mirrored."""
RADIUS_STRIDES = 0.75
"""A fix is correct if its error is below this many strides."""
MIN_VALID = 0.9
"""Least share of valid pixels in a crop, where there are too few whole ones."""
ENOUGH_CROPS = 48
"""Whole crops from which on no others are taken."""
MIN_RIGHT = 10
"""Fewest correct fixes for a fit of all weights."""


@dataclass(frozen=True, eq=False)
class Crop:
    """Grey levels (S, S) cropped from the reference, and the pixel position of its centre."""

    grey: NDArray[np.uint8]
    row_px: float
    col_px: float


@dataclass(frozen=True)
class TileCalibration:
    """Calibration of tile matches.

    `position_std_m`: standard deviation per axis of a correct fix.
    """

    confidence: LogisticConfidence
    position_std_m: float


class CropSampler:
    """Collects crops at random positions from a stream of blocks of imagery."""

    def __init__(self, tile_px: int, seed: int, sheet_px: float = math.inf) -> None:
        """`sheet_px`: shorter side of the sheet; on a small one crops are no larger than tiles."""
        self._rng = np.random.default_rng([seed, 1])
        self._tile_px = tile_px
        is_small = sheet_px < SMALL_TILES * tile_px
        self.size_px = tile_px if is_small else round(tile_px * CROP_TILES)
        self._whole: list[Crop] = []
        self._partial: list[Crop] = []

    def places(self, height: int, width: int, share: float) -> NDArray[np.intp]:
        """Random first pixels (row, col), (N, 2), of crops in a block.

        `share`: size of the block as a share of all imagery. Independent of the imagery, so that
        blocks may be read in any order once positions are drawn for all.
        """
        size = self._crop_px(height, width)
        if size < self._tile_px:
            return np.zeros((0, 2), np.intp)
        drawn = [
            [self._rng.integers(0, height - size + 1), self._rng.integers(0, width - size + 1)]
            for _ in range(self._rng.poisson(2.0 * CROPS * share))
        ]
        return np.array(drawn, np.intp).reshape(-1, 2)

    def cut(
        self, grey: NDArray[np.uint8], valid: NDArray[np.bool_], places: NDArray[np.intp]
    ) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
        """Crops (N, S, S) of a block at places with contrast; these places and whether all pixels
        are valid (N, 3).

        Few pixels may be invalid, such as marks on the imagery; they get the mean grey level.
        """
        size = self._crop_px(*grey.shape)
        crops = np.zeros((len(places), size, size), np.uint8)
        found: list[tuple[int, int, bool]] = []
        for row, col in places:
            part = np.s_[row : row + size, col : col + size]
            crop, inside = grey[part], valid[part]
            share = inside.mean()
            if share >= MIN_VALID and crop[inside].std() > 1:
                crops[len(found)] = np.where(inside, crop, crop[inside].mean().round())
                found.append((row, col, share == 1))
        return crops[: len(found)], np.array(found, np.intp).reshape(-1, 3)

    def take(
        self, crops: NDArray[np.uint8], places: NDArray[np.intp], row_px: int, col_px: int
    ) -> None:
        """Add the crops of a block whose first pixel is (row_px, col_px) of the sheet.

        `crops`, `places`: of `cut`.
        """
        for grey, (row, col, whole) in zip(crops, places.tolist(), strict=True):
            known = self._whole if whole else self._partial
            if len(known) < 2 * CROPS:
                half = grey.shape[0] / 2
                known.append(Crop(grey.copy(), row_px + row + half, col_px + col + half))

    @property
    def crops(self) -> list[Crop]:
        """The whole crops, with others where these are fewer than `ENOUGH_CROPS`."""
        missing = max(ENOUGH_CROPS - len(self._whole), 0)
        return self._whole + self._partial[:missing]

    def _crop_px(self, height: int, width: int) -> int:
        return min(height, width, self.size_px)


def calibrate(
    sampler: CropSampler,
    grid: TileGrid,
    representation: Any,
    embedder: ViewEmbedder,
    embeddings: NDArray[np.float16],
    centres_en_m: NDArray[np.float32],
    heading_step_deg: float,
    progress: Progress,
    *,
    usual: LogisticConfidence | None,
    slow: bool = False,
) -> TileCalibration:
    """Search changed and mirrored crops on the new map and fit the confidence to the outcome.

    `usual`: the confidence of such embeddings on other maps, None if unknown. A `slow`
    representation (minutes per crop) is tried on `SLOW_CROPS` only.
    """
    sampled = sampler.crops
    rng = np.random.default_rng([len(sampled), 2])
    matcher = TileMatcher(grid, centres_en_m, embeddings)
    most = min(CROPS, SLOW_CROPS) if slow else CROPS
    crops = [sampled[i] for i in rng.permutation(len(sampled))[:most]]
    features, errors, mirrored = [], [], []
    for done, crop in enumerate(crops):
        other = crops[int(rng.integers(len(crops)))].grey
        if rng.random() > PASTED_SHARE:
            other = other[:, ::-1]
        for mirror in (False, True):
            picture = crop.grey[:, ::-1] if mirror else crop.grey
            changed = changed_picture(rng, picture, other)
            queries = _queries(rng, changed, grid, representation, embedder, heading_step_deg)
            match = matcher.match(queries)
            features.append([match.evidence[name] for name in FEATURES])
            truth = [
                grid.west_m + crop.col_px * grid.gsd_m,
                grid.north_m - crop.row_px * grid.gsd_m,
            ]
            errors.append(centres_en_m[match.tile] + np.array(match.shift_en_m) - truth)
            mirrored.append(mirror)
        progress("calibrate", (done + 1) / len(crops))
    return _fitted(
        np.array(features).reshape(-1, len(FEATURES)),
        np.array(errors).reshape(-1, 2),
        np.array(mirrored, dtype=bool),
        grid,
        usual,
    )


def _fitted(
    features: NDArray[np.float64],
    errors_en_m: NDArray[np.float64],
    mirrored: NDArray[np.bool_],
    grid: TileGrid,
    usual: LogisticConfidence | None,
) -> TileCalibration:
    near = np.hypot(*errors_en_m.T) <= RADIUS_STRIDES * grid.stride_m
    right = near & ~mirrored
    weight = np.where(mirrored, MIRRORED_WEIGHT, 1.0)
    if right.sum() < MIN_RIGHT:
        return TileCalibration(fit_few(features, right, weight, usual), grid.stride_m)
    confidence = fit_logistic(features, right, weight)
    std_m = float(np.sqrt(np.mean(errors_en_m[right] ** 2)))
    return TileCalibration(confidence, max(std_m, grid.gsd_m))


def changed_picture(
    rng: np.random.Generator, grey: NDArray[np.uint8], other: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """`grey` (S, S) with simulated ageing: light, blur, noise, replaced parts."""
    size = grey.shape[0]
    other = np.asarray(cv2.resize(other, (size, size)), dtype=np.uint8)
    mask = cv2.resize(
        rng.random((8, 8)).astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC
    )
    replaced = mask < np.quantile(mask, rng.uniform(0, MAX_REPLACED))
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
    heading_step_deg: float,
) -> NDArray[np.float32]:
    """Embeddings (3, D) of the centre of an image at the headings that the localizer tries."""
    heading = rng.normal(0, HEADING_STD_DEG)
    scale = float(np.exp(rng.normal(0, SCALE_STD)))
    size, middle = grid.tile_px, (picture.shape[0] - 1) / 2
    inside = np.ones(picture.shape, dtype=np.uint8)
    queries = []
    for step in (-heading_step_deg, 0.0, heading_step_deg):
        matrix = cv2.getRotationMatrix2D((middle, middle), heading + step, scale)
        matrix[:, 2] -= middle - (size - 1) / 2
        view = np.asarray(cv2.warpAffine(picture, matrix, (size, size)), dtype=np.uint8)
        valid = np.asarray(cv2.warpAffine(inside, matrix, (size, size)) > 0, dtype=np.bool_)
        queries.append(embedder.view(representation(view, valid), valid))
    return np.stack(queries)
