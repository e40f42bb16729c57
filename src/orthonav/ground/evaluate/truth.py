"""Whether true positions belong to the fixes or the map that they are compared with."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from orthonav.core.errors import FlightError
from orthonav.core.geo.frames import distances_m
from orthonav.core.geo.swapped import HINT
from orthonav.core.records import Fix, ViewResult

FAR_M = 50_000.0
"""A larger median error is none of the method: maps of one sheet are smaller."""
SWAPPED_M = 1000.0
"""Nearer true positions are not examined: latitude and longitude may be nearly equal."""
log = logging.getLogger(__name__)


def check_truth(
    truth: Mapping[str, tuple[float, float]],
    results: Sequence[ViewResult],
    centre_latlon_deg: tuple[float, float] | None,
    path: Path,
) -> None:
    """Log a warning where true positions are far from the fixes of the same views or, without any,
    from the centre of the map.

    Raises `FlightError` where they are near once latitude and longitude are exchanged.
    """
    both = [
        (truth[result.frame], (result.outcome.lat_deg, result.outcome.lon_deg))
        for result in results
        if isinstance(result.outcome, Fix) and result.frame in truth
    ]
    compared = "the fixes" if both else "the map"
    if not both and centre_latlon_deg is not None:
        both = [(place, centre_latlon_deg) for place in truth.values()]
    if not both:
        return
    true, expected = np.array(both).transpose(1, 0, 2)
    far_m, swapped_m = (
        float(np.nanmedian(distances_m(places, expected))) for places in (true, true[:, ::-1])
    )
    far = f"true positions are {far_m / 1000:,.0f} km from {compared} (median)"
    if far_m > SWAPPED_M and swapped_m < far_m / 10:
        raise FlightError(f"{far}; {HINT}: {path}")
    if far_m > FAR_M:
        log.warning("%s; are these of the same flight?: %s", far, path)
