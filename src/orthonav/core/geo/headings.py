"""Detection of headings in radians, for messages of all that reads headings."""

import math
from collections.abc import Sequence

RADIANS = (
    "all headings are within -2 pi to 2 pi, as in radians; check the unit of the heading column"
)
_FEWEST = 4
_VARIED = 2.0  # headings in degrees that vary by less rarely lie around 0


def seem_radians(yaw_deg: Sequence[float]) -> bool:
    known = [value for value in yaw_deg if math.isfinite(value)]
    if len(known) < _FEWEST:
        return False
    within = all(abs(value) <= 2 * math.pi for value in known)
    return within and max(known) - min(known) > _VARIED
