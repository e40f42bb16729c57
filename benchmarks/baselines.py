"""Baselines a user would write first: OpenCV's template matching and SIFT, on one rectified view.

Each method takes a view with its telemetry and returns a place in the sheet, or None.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.localize import Localizer
from orthonav.core.localize.rectify import RectifiedView, downsampled
from orthonav.core.records import Fix, View
from orthonav.core.tiles.represent import Canny
from orthonav.ground.imagery.mosaic import Mosaic

JPEG_QUALITY = 90
LOWE = 0.75
MIN_INLIERS = 8
RANSAC_PX = 4.0
SIFT_BORDER_PX = 9
Place = NDArray[np.float64] | None


class Method(Protocol):
    """A method that locates a view; `carried` is the data needed aboard, name -> bytes."""

    name: str
    carried: tuple[str, int]

    def locate(self, view: View) -> Place:
        """East and north (2,) of the camera in the sheet, None for no answer."""
        ...


class Orthonav:
    """A map and the localizer, as `orthonav localize` uses them."""

    def __init__(self, name: str, localizer: Localizer, size_bytes: int) -> None:
        self.name = name
        self.carried = ("map", size_bytes)
        self._localizer = localizer

    def locate(self, view: View) -> Place:
        """The fix, at any confidence."""
        found = self._localizer.locate(view)
        if not isinstance(found, Fix):
            return None
        return self._localizer.sheet.frame.en_from_latlon(found.lat_deg, found.lon_deg)


@dataclass(frozen=True, eq=False)
class Reference:
    """The orthophoto in the raster of an orthonav map: same plane, same pixels.

    `grey` (H, W) has the mean grey level where `valid` is false.
    """

    localizer: Localizer
    grey: NDArray[np.uint8]
    valid: NDArray[np.bool_]

    @classmethod
    def of(cls, ortho: Path, localizer: Localizer) -> "Reference":
        """Read the whole sheet."""
        grid = localizer.grid
        with Mosaic.open([ortho]).grid_sheet(localizer.sheet.frame, grid) as raster:
            pixels = raster.read(0, 0, grid.width_px, grid.height_px)
        mean = round(float(pixels.grey[pixels.valid].mean()))
        return cls(
            localizer, np.where(pixels.valid, pixels.grey, mean).astype(np.uint8), pixels.valid
        )

    def rectified(self, view: View, turns_deg: Sequence[float]) -> list[RectifiedView]:
        """The view as orthonav would rectify it, under the reported heading and offsets from it."""
        yaw_deg = view.telemetry.yaw_deg
        smaller = downsampled(view, self.localizer.grid.gsd_m)
        return [self.localizer.tiles.rectified(smaller, yaw_deg + turn) for turn in turns_deg]

    def place_en_m(self, col_px: float, row_px: float) -> NDArray[np.float64]:
        """Position in the sheet of a pixel coordinate (outer corner of the first pixel: 0, 0)."""
        grid = self.localizer.grid
        return np.array([grid.west_m + col_px * grid.gsd_m, grid.north_m - row_px * grid.gsd_m])

    @cached_property
    def jpeg_bytes(self) -> int:
        """Size of the grey orthophoto as JPEG."""
        options = [int(cv2.IMWRITE_JPEG_QUALITY), JPEG_QUALITY]
        return len(cv2.imencode(".jpg", self.grey, options)[1])

    @cached_property
    def png_bytes(self) -> int:
        """Size of the grey orthophoto as PNG, without loss."""
        return len(cv2.imencode(".png", self.grey)[1])

    @cached_property
    def edges(self) -> NDArray[np.uint8]:
        """Canny edges (H, W), 255 on an edge, with the paper's parameters."""
        return canny_edges(self.grey, self.valid)


class TemplateMatch:
    """`cv2.matchTemplate` (TM_CCOEFF_NORMED) of the view over the whole orthophoto.

    The template is the largest square around the view's centre that the camera saw under every
    heading tried. The best of the headings counts.
    """

    def __init__(self, reference: Reference, *, canny: bool, turns_deg: Sequence[float]) -> None:
        what = "Canny edges" if canny else "grey"
        headings = "reported heading" if len(turns_deg) == 1 else f"{len(turns_deg)} headings"
        self.name = f"matchTemplate, {what}, {headings}"
        self.reference, self._canny, self.turns_deg = reference, canny, turns_deg
        self._picture = reference.edges if canny else reference.grey
        if canny:
            one_bit = [int(cv2.IMWRITE_PNG_BILEVEL), 1]
            self.carried = (
                "edges, 1-bit PNG",
                len(cv2.imencode(".png", self._picture, one_bit)[1]),
            )
        else:
            self.carried = ("orthophoto, grey JPEG", reference.jpeg_bytes)

    def locate(self, view: View) -> Place:
        """Position of the highest correlation."""
        views = self.reference.rectified(view, self.turns_deg)
        middle = views[0].grey.shape[0] // 2
        half = min(_seen_half_px(one.valid) for one in views)
        part = np.s_[middle - half : middle + half, middle - half : middle + half]
        best, place = -np.inf, None
        for one in views:
            picture = canny_edges(one.grey, one.valid) if self._canny else one.grey
            template = np.ascontiguousarray(picture[part])
            scores = cv2.matchTemplate(self._picture, template, cv2.TM_CCOEFF_NORMED)
            _, score, _, (col, row) = cv2.minMaxLoc(scores)
            if score > best:
                found = self.reference.place_en_m(col + half, row + half)
                best, place = score, found - one.offset_en_m
        return place


class SiftMatch:
    """SIFT with the ratio test and a RANSAC similarity; keypoints of the orthophoto are ready."""

    def __init__(self, reference: Reference) -> None:
        self.name = "SIFT, ratio test, RANSAC"
        self._reference = reference
        self._sift = cv2.SIFT.create()
        points, descriptors = self._features(reference.grey, reference.valid)
        self._points = points
        self._matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 5}, {"checks": 64})
        self._matcher.add([descriptors])
        self._matcher.train()
        self.carried = ("keypoints, 136 bytes each", 136 * len(points))

    def locate(self, view: View) -> Place:
        """Position of the centre of the view; None with fewer than `MIN_INLIERS` inliers."""
        seen = self._reference.rectified(view, [0.0])[0]
        points, descriptors = self._features(seen.grey, seen.valid)
        if len(points) < 2:
            return None
        pairs = self._matcher.knnMatch(descriptors, k=2)
        good = [pair[0] for pair in pairs if len(pair) == 2 and _distinct(*pair)]
        if len(good) < MIN_INLIERS:
            return None
        matrix, inliers = cv2.estimateAffinePartial2D(
            points[[match.queryIdx for match in good]],
            self._points[[match.trainIdx for match in good]],
            method=cv2.RANSAC,
            ransacReprojThreshold=RANSAC_PX,
        )
        if matrix is None or int(inliers.sum()) < MIN_INLIERS:
            return None
        centre = matrix @ [*(np.array(seen.grey.shape[::-1]) / 2), 1.0]
        return np.asarray(self._reference.place_en_m(*centre) - seen.offset_en_m)

    def _features(
        self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], Any]:
        """Keypoints (N, 2), pixel-is-area, and descriptors; none along missing imagery."""
        kernel = np.ones((SIFT_BORDER_PX, SIFT_BORDER_PX), np.uint8)
        mask = cv2.erode(valid.astype(np.uint8), kernel, borderValue=1)
        keypoints, descriptors = self._sift.detectAndCompute(grey, mask)
        points = np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2) + 0.5
        return points, descriptors


def _distinct(first: Any, second: Any) -> bool:
    return bool(first.distance < LOWE * second.distance)


def canny_edges(grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Edge map (H, W) of 0 and 255."""
    return np.asarray(Canny()(grey, valid)[0] * 255, dtype=np.uint8)


def _seen_half_px(valid: NDArray[np.bool_]) -> int:
    """Half the side of the largest square around the centre of (S, S) that is all valid."""
    size = valid.shape[0]
    reach = np.abs(np.arange(size) + 0.5 - size / 2)
    missing = np.maximum(reach[:, None], reach)[~valid]
    return int(missing.min(initial=size / 2))
