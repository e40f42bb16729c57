"""Image representations that are compared: grey levels, edges or gradients.

Grey levels, Canny and Segment Anything are those of Di Piazza et al. 2024, section Methodology.

`variant(grey, valid)` with (H, W) uint8 and bool gives float32 `(C, H, W)`, zero where not valid.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import VariantError
from orthonav.core.variants import Checked, Variant, choice, within

Grey = NDArray[np.uint8]
Mask = NDArray[np.bool_]
HARMONICS = 3  # chosen on imagery of two dates (docs/decisions/embedding.md)


def filled(grey: Grey, valid: Mask) -> Grey:
    """The picture (H, W) with the mean grey level where it is not valid."""
    if not valid.all():
        grey = np.where(valid, grey, np.uint8(round(float(grey[valid].mean()))))
    return np.ascontiguousarray(grey)


def inner(valid: Mask, side_px: int) -> Mask:
    """Pixels (H, W) around which a square is valid, as far as it lies within the picture."""
    square = np.ones((side_px, side_px), np.uint8)
    eroded = cv2.erode(valid.astype(np.uint8), square, borderValue=1)
    return np.asarray(eroded.reshape(valid.shape) > 0)


@dataclass(frozen=True)
class OrientedGradients(Checked):
    """(7, H, W), levels per pixel: magnitude, real and imaginary part of harmonics 1 to 3."""

    sigma_px: float = within(1.5, 0, 16, above=True)

    channels = 1 + 2 * HARMONICS

    @property
    def margin_px(self) -> int:
        return int(np.ceil(4 * self.sigma_px)) + 1  # OpenCV's kernel of 4 sigma, then Scharr

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        smooth = cv2.GaussianBlur(
            np.asarray(grey, dtype=np.float32), (0, 0), self.sigma_px
        ).reshape(grey.shape)
        east = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32)
        south = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)
        out = np.empty((self.channels, *grey.shape), dtype=np.float32)
        power, south2 = east * east, south * south
        cos = power - south2
        power += south2
        np.sqrt(power, out=out[0])
        if not valid.all():
            out[0] *= inner(valid, 2 * self.margin_px + 1)
        power += np.float32(1e-6)
        cos /= power
        sin = np.multiply(east, south, out=south2)
        sin *= 2 / power
        _fill_harmonics(out, cos, sin)
        return out


def _fill_harmonics(
    out: NDArray[np.float32], cos: NDArray[np.float32], sin: NDArray[np.float32]
) -> None:
    """In place, each from the one before: fresh arrays would cost more than the arithmetic."""
    product = np.empty_like(cos)
    np.multiply(out[0], cos, out=out[1])
    np.multiply(out[0], sin, out=out[2])
    for k in range(2, HARMONICS + 1):
        real, imaginary = out[2 * k - 3], out[2 * k - 2]
        np.multiply(real, cos, out=out[2 * k - 1])
        out[2 * k - 1] -= np.multiply(imaginary, sin, out=product)
        np.multiply(real, sin, out=out[2 * k])
        out[2 * k] += np.multiply(imaginary, cos, out=product)
    # A triangular bin of a histogram of 8 orientations passes harmonic k with the weight
    # sinc(k / 8)^2.
    for k in range(1, HARMONICS + 1):
        out[2 * k - 1 : 2 * k + 1] *= np.float32(np.sqrt(2) * np.sinc(k / 8) ** 2)


TABLE = {
    "gradient": Variant("orthonav.core.tiles.represent:OrientedGradients"),
    "gray": Variant("orthonav.core.tiles.represent:Gray"),
    "canny": Variant("orthonav.core.tiles.represent:Canny"),
    "segments": Variant("orthonav.research.segments:Segments", extra="segments"),
    "onnx": Variant("orthonav.core.tiles.learned:LearnedEdges", extra="neural"),
    "sam": Variant("orthonav.research.sam:SamBoundaries", flies=False, extra="train"),
}


@dataclass(frozen=True)
class Gray:
    """0..1, (1, H, W)."""

    channels = 1

    margin_px = 0

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        return np.where(valid, grey, 0).astype(np.float32)[None] / np.float32(255)


@dataclass(frozen=True)
class Canny(Checked):
    """Binary edges, by default of "a threshold in the interval [100, 200] and a kernel of size 3".

    We read this as the low and the high threshold, on the Sobel gradient of 8-bit grey levels; the
    L1 norm is our choice. `kernel`: aperture 3, 5 or 7."""

    low: float = 100.0
    high: float = 200.0
    kernel: int = choice(3, 5, 7)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.low <= self.high:
            raise VariantError(f"canny needs 0 <= low <= high, got {self.low}, {self.high}")

    channels = 1

    @property
    def margin_px(self) -> int:
        """Without hysteresis."""
        return self.kernel // 2 + 2

    def __call__(self, grey: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        """None along the border of `valid`."""
        edges = cv2.Canny(np.ascontiguousarray(grey), self.low, self.high, apertureSize=self.kernel)
        if not valid.all():
            edges = edges * inner(valid, self.kernel + 2)
        return (edges > 0).astype(np.float32)[None]
