"""Checks that an answer is the image that was requested; everything else is refused by its fault.

A service may answer 200 with a web page, an error in XML, a tile of another size, half a file, or a
placeholder. Each would become a wrong area in a map. So the format is read from the bytes, the size
is checked before anything is decoded, and half a file is an error.
"""

import io
import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from orthonav.core.errors import described
from orthonav.core.geo.ground import HIGHEST_M, LOWEST_M
from orthonav.ground.fetch.client import (
    BadReplyError,
    HttpReply,
    bad_status,
    exception_text,
    excerpt,
)

FORMATS = ("JPEG", "PNG", "WEBP")
_JPEG_END = b"\xff\xd9"
MIN_EMPTY_PX = 4096
"""Smallest patch of the empty colour that is masked, 64 x 64 px: larger than a roof or shadow."""
_EMPTY_COLOURS = {"black": 0, "white": 255}
_NOT_COVERED = re.compile(
    r"TileOutOfRange|no data found|out of (the )?(range|bounds|extent)|not covered", re.IGNORECASE
)
Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class CellPixels:
    """Pixels of a cell: `bands` (C, H, W) and `valid` (H, W) bool."""

    bands: Array
    valid: NDArray[np.bool_]

    @property
    def blank(self) -> bool:
        """Whether there is no imagery: no valid pixel, or pure black or white throughout.

        Heights, which are signed numbers, are never blank where they are valid.
        """
        if not self.valid.any() or self.bands.dtype.kind != "u":
            return not self.valid.any()
        first = self.bands[:, 0, 0]
        if not (first == first[0]).all() or first[0] not in (0, np.iinfo(np.uint8).max):
            return False
        return bool((self.bands == first[:, None, None]).all())


def image_or_absent(
    reply: HttpReply,
    shape_px: tuple[int, int],
    empty: str | None,
    *,
    tiled: bool = True,
    heights: bool = False,
) -> bytes | None:
    """The body of an answer that is an image, or `heights`, of this shape (height, width).

    None where the service reports that it has no imagery there; 404 means that only for a `tiled`
    service. Raises `BadReplyError` for everything else, with the content that came.
    """
    if reply.status == 204 or (tiled and reply.status in (404, 410)):
        return None
    if reply.status != 200:
        error = bad_status(reply)
        if reply.status == 400 and _NOT_COVERED.search(str(error)):
            return None
        raise error
    whole = heights and len(reply.body) == 4 * shape_px[0] * shape_px[1]
    if not whole and _looks_like_text(reply):  # a height may begin with the byte of "<"
        words = exception_text(reply)
        if words and _NOT_COVERED.search(words):
            return None
        what = "an error of the service" if words else "a page or text"
        raise BadReplyError(f"{what} instead of an image ({words or excerpt(reply)})")
    if heights:
        decode_heights(reply.body, shape_px)
    else:
        decode(reply.body, shape_px, empty)
    return reply.body


def decode_heights(body: bytes, shape_px: tuple[int, int]) -> CellPixels:
    """Heights in metres of raw little-endian float32 of exactly this shape (height, width).

    Values that no ground can have stand for no data. Raises `BadReplyError` for another size.
    """
    height, width = shape_px
    if len(body) != 4 * height * width:
        raise BadReplyError(f"{len(body)} bytes instead of {height} x {width} heights of 4 bytes")
    heights = np.frombuffer(body, "<f4").reshape(1, height, width).astype(np.float32)
    with np.errstate(invalid="ignore"):
        valid = (heights[0] >= LOWEST_M) & (heights[0] <= HIGHEST_M)
    return CellPixels(np.where(valid, heights, np.float32(0)), valid)


def decode(body: bytes, shape_px: tuple[int, int], empty: str | None) -> CellPixels:
    """Red, green, blue and validity of an image of exactly this shape (height, width).

    Transparent pixels are invalid; with `empty` ("black" or "white"), large patches of exactly that
    colour are too. Raises `BadReplyError` where it is not such an image, or half of one.
    """
    height, width = shape_px
    try:
        with Image.open(io.BytesIO(body), formats=FORMATS) as image:  # reads only the head
            if image.size != (width, height):
                raise BadReplyError(
                    f"image of {image.size[0]} x {image.size[1]} px instead of {width} x {height}",
                    again=False,
                )
            if image.format == "JPEG" and _JPEG_END not in body[-64:]:
                raise BadReplyError("image is cut short")
            rgb, alpha = _channels(image)
    except BadReplyError:
        raise
    except UnidentifiedImageError:
        raise BadReplyError("not an image (JPEG, PNG or WebP)") from None
    except (OSError, ValueError, SyntaxError, Warning, Image.DecompressionBombError) as error:
        raise BadReplyError(f"image is broken ({described(error)})") from None
    valid = np.ones((height, width), dtype=bool) if alpha is None else alpha > 0
    if empty is not None:
        valid &= ~_empty_patches(rgb, _EMPTY_COLOURS[empty])
    return CellPixels(np.ascontiguousarray(rgb.transpose(2, 0, 1)), valid)


def _channels(image: Any) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Red, green, blue (H, W, 3), and alpha (H, W) if there is one."""
    if image.mode not in ("1", "L", "LA", "P", "RGB", "RGBA"):
        raise BadReplyError(f"image of an unknown kind ({image.mode})", again=False)
    if image.mode in ("LA", "RGBA") or "transparency" in image.info:
        pixels = np.asarray(image.convert("RGBA"))
        return pixels[..., :3], pixels[..., 3]
    return np.asarray(image.convert("RGB")), None


def _empty_patches(rgb: NDArray[np.uint8], level: int) -> NDArray[np.bool_]:
    """Pixels (H, W) of patches of exactly this level in all bands, of `MIN_EMPTY_PX` or more."""
    pure = (rgb == level).all(axis=2).astype(np.uint8)
    if int(pure.sum()) < MIN_EMPTY_PX:
        return np.zeros(pure.shape, dtype=bool)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(pure, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= MIN_EMPTY_PX
    large[0] = False  # the other colours
    return np.asarray(large[labels])


def _looks_like_text(reply: HttpReply) -> bool:
    """By its first character, because media types are often wrong."""
    return reply.body[:256].lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"<", b"{")
