"""Odometry between views whose pitch and roll are not as reported."""

import math

import numpy as np
import pytest
from blots import AGL_M, GROUND, rendered

from orthonav.core.geo.camera import Camera
from orthonav.core.localize.odometry import OdometryView, displacement
from orthonav.core.records import Telemetry, View

CAMERA = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
NOISE = np.array([1e-3, 4e-4, 1e-3])
LEVEL = (0.0, 0.0)


def seen(number, place, heading, tilt, pixel_m, corrected=LEVEL):
    """A view that is reported level; what its tilt is corrected by, degrees."""
    grey = rendered(GROUND, place, (heading, *tilt), AGL_M, CAMERA)
    telemetry = Telemetry(number * 10**9, heading, 0.0, 0.0, AGL_M)
    bias = np.array([0.0, 0.0, *np.radians(corrected)])
    return OdometryView.of(View(grey, CAMERA, telemetry), pixel_m, bias)


@pytest.mark.parametrize("heading", [0.0, 130.0])
@pytest.mark.parametrize(
    ("before", "now", "corrected"),
    [
        (LEVEL, (3.0, 0.0), LEVEL),
        (LEVEL, (0.0, -3.0), LEVEL),
        ((-2.0, 1.5), LEVEL, LEVEL),
        ((4.0, -3.0), (6.0, -2.0), (4.0, -2.5)),
    ],
    ids=["pitch", "roll", "before", "corrected"],
)
def test_a_tilt_that_is_not_reported_displaces_by_its_lever(heading, before, now, corrected):
    moved_m = np.array([12.0, -7.0])
    first = seen(0, (0.0, 0.0), heading, before, None, corrected)
    second = seen(1, moved_m, heading, now, first.pixel_m, corrected)
    found = displacement(first, second, 0.0, NOISE).displacement
    assert np.degrees(found.corrected_rad) == pytest.approx(np.array([corrected] * 2))
    of_now, of_before = (
        lever @ (np.radians(tilt) - known)
        for lever, tilt, known in zip(
            found.levers_m, (now, before), found.corrected_rad, strict=True
        )
    )
    assert np.hypot(*(of_now - of_before)) > 3
    assert found.moved_en_m == pytest.approx(moved_m + of_now - of_before, abs=1.5)
    assert np.linalg.norm(found.levers_m[0], axis=0) == pytest.approx([AGL_M] * 2, rel=0.01)
    assert math.degrees(found.turned_rad) == pytest.approx(0.0, abs=0.5)
