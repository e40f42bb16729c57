"""Simulated clouds below an aircraft: stretches of a flight in which they close and open."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.camera import Camera, footprint_en_m

FEWEST_VIEWS, MOST_VIEWS = 10, 40  # length of a cloudy stretch in views
EDGE = 0.25  # fraction of a stretch, at each end, over which the clouds close
BROKEN = 0.3  # fraction of the stretches whose clouds never close
HEIGHT = 0.5  # height of the clouds as a fraction of the aircraft's
SOFTNESS = 0.25  # width of a cloud edge, as a fraction of the range of cloud cover
TEXTURE_PX, TEXTURE_VIEWS = 512, 4.0  # period: pixels, lengths of a view
BLOB_PX = 40.0  # size of the largest clouds in pixels of the texture
GRID = 8  # clouds are rendered at this fraction of the resolution of the view
Array = NDArray[np.float64]


class Clouds:
    """Clouds of a flight of `count` views, a `share` (0..1) of which are cloudy; `partial(Clouds,
    0.2)` is what `SimulateRequest.clouds` takes."""

    def __init__(self, share: float, count: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 3])
        self._degree, self._stretch = _stretches(count, share, rng)
        self._level = rng.uniform(190, 245, count)
        self._contrast = rng.uniform(0, 12, count)
        self._ranks = _texture(rng)

    def degree(self, number: int) -> float:
        """Cloud cover of a view: 0 clear, 1 fully covered."""
        return float(self._degree[number])

    def __call__(
        self,
        number: int,
        camera: Camera,
        attitude: tuple[float, float, float, float],
        en_m: Array,
        picture: NDArray[np.uint8],
    ) -> NDArray[np.uint8]:
        """The picture (H, W, 3) of a view with the clouds below. `attitude`: heading, pitch, roll
        (deg) and height (m). `en_m`: position (2,)."""
        degree, stretch = self.degree(number), int(self._stretch[number])
        if degree <= 0:
            return picture
        *angles, agl_m = attitude
        below_m = agl_m * (1 - HEIGHT)
        corners = en_m + footprint_en_m(camera, angles[0], angles[1], angles[2], below_m)
        across_m = TEXTURE_VIEWS * below_m * max(camera.extent)
        size = math.ceil(camera.width_px / GRID) + 1, math.ceil(camera.height_px / GRID) + 1
        ranks = _sampled(self._ranks, corners / across_m * TEXTURE_PX + 97.0 * stretch, size)
        inside = np.clip((degree * (1 + SOFTNESS) - ranks) / SOFTNESS, 0, 1)
        opacity = inside * inside * (3 - 2 * inside)
        shade = _sampled(self._ranks, corners / across_m * TEXTURE_PX * 2 + 31.0, size) - 0.5
        grey = self._level[stretch] + self._contrast[stretch] * shade
        whole = (camera.width_px, camera.height_px)
        cover, light = (_enlarged(part, whole)[..., None] for part in (opacity, grey))
        return np.asarray(picture * (1 - cover) + cover * light, dtype=np.uint8)


def _stretches(
    count: int, share: float, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64]]:
    """Cloud cover (N,) and number of the stretch (N,) of each view."""
    wanted = round(share * count)
    lengths: list[int] = []
    while sum(lengths) < wanted:
        lengths.append(min(int(rng.integers(FEWEST_VIEWS, MOST_VIEWS + 1)), wanted - sum(lengths)))
    starts = np.sort(rng.integers(0, count - wanted + 1, len(lengths)))
    degree, stretch = np.zeros(count), np.zeros(count, dtype=np.int64)
    passed = 0
    for number, (free, length) in enumerate(zip(starts, lengths, strict=True)):
        first = int(free) + passed
        passed += length
        edge = 1 + EDGE * length
        place = np.arange(length)
        most = rng.uniform(0.4, 0.9) if rng.uniform() < BROKEN else 1.0
        closed = np.minimum(place + 1, length - place) / edge
        degree[first : first + length] = most * np.minimum(closed, 1)
        stretch[first : first + length] = number
    return degree, stretch


def _texture(rng: np.random.Generator) -> NDArray[np.float32]:
    """A seamless periodic random texture (S, S), as ranks: uniform from 0 to 1."""
    frequency = np.fft.fftfreq(TEXTURE_PX)
    radius = np.hypot(frequency[:, None], frequency[None])
    power = (radius**2 + (1 / BLOB_PX) ** 2) ** -1.5
    field = np.fft.ifft2(np.fft.fft2(rng.normal(0, 1, (TEXTURE_PX, TEXTURE_PX))) * power).real
    ranks = np.empty(field.size, dtype=np.float32)
    ranks[np.argsort(field, axis=None, kind="stable")] = np.linspace(0, 1, field.size)
    return ranks.reshape(field.shape)


def _sampled(texture: NDArray[np.float32], corners_px: Array, size: tuple[int, int]) -> Array:
    """The texture (h, w) between four corners (4, 2), clockwise from the top left."""
    across, down = np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1])[:, None, None]
    top = corners_px[0] + across[:, None] * (corners_px[1] - corners_px[0])
    bottom = corners_px[3] + across[:, None] * (corners_px[2] - corners_px[3])
    maps = (top + down * (bottom - top)) % TEXTURE_PX
    wrapped = cv2.copyMakeBorder(texture, 0, 1, 0, 1, cv2.BORDER_WRAP)
    # The stubs of OpenCV require the argument that is None.
    seen = cv2.remap(wrapped, maps.astype(np.float32), None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    return np.asarray(seen, dtype=np.float64)


def _enlarged(part: Array, size: tuple[int, int]) -> NDArray[np.float32]:
    enlarged = cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(enlarged, dtype=np.float32)
