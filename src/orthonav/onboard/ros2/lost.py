"""Images that were lost on their way, by the messages that come with them."""

from bisect import bisect_left, bisect_right
from collections import deque
from itertools import pairwise

WINDOW_NS = 10 * 10**9
LOST_SHARE, LEAST_IMAGES = 0.2, 5
IRREGULAR = 2
"""Steps from image to image, in messages of the camera, differ by less where a node between passes
every n-th image on."""


class LostImages:
    """Stamps of the images and of the `camera_info` that arrived; a camera gives both the same.

    An image is sent in many parts and lost with one of them, its `camera_info` is a single part.
    """

    def __init__(self) -> None:
        self.images: deque[int] = deque(maxlen=1000)
        self.infos: deque[int] = deque(maxlen=1000)

    def reason(self) -> str | None:
        """What is wrong where more than `LOST_SHARE` of the last seconds' images are missing."""
        infos = sorted(self.infos)
        images = sorted(self.images)
        if not images:
            return None
        images = images[bisect_left(images, images[-1] - WINDOW_NS) :]
        if len(images) < LEAST_IMAGES:
            return None
        steps = [bisect_right(infos, b) - bisect_right(infos, a) for a, b in pairwise(images)]
        lost = sum(max(step - 1, 0) for step in steps)
        if lost <= LOST_SHARE * (lost + len(images)) or max(steps) - min(steps) < IRREGULAR:
            return None
        return (
            "loses images: use compressed ones, image_reliability:=reliable, or a larger "
            "net.core.rmem_max"
        )
