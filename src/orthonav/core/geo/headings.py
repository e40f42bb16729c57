"""Detection of headings in radians, for messages of all that reads headings."""

import math
from collections.abc import Sequence

RADIANS = (
    "all headings are within -2 pi to 2 pi, as in radians; check the unit of the heading column"
)


def seem_radians(yaw_deg: Sequence[float]) -> bool:
    known = [value for value in yaw_deg if math.isfinite(value)]
    if len(known) < 4:
        return False
    within = all(abs(value) <= 2 * math.pi for value in known)
    return within and max(known) - min(known) > 2.0  # degrees that vary by less rarely lie around 0
