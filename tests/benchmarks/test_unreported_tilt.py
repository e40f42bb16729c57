"""The benchmark of unreported tilt: what it compares a fix with."""

import numpy as np
import pytest
from benchmarks.scenes import root_agl_of
from benchmarks.unreported_tilt import Flown, compared, level_telemetry

from orthonav.core.geo.camera import Camera, axis_on_ground_en_m
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, Telemetry, View
from orthonav.ground.simulate.flight import DEFAULT_CAMERA

CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
TRUE = Telemetry(0, 30.0, 4.0, -3.0, 250.0)
FRAME = LocalFrame(48.0, 2.0)
ATTITUDE = TRUE.yaw_deg, TRUE.pitch_deg, TRUE.roll_deg


def fix_at(place_en_m, **evidence):
    lat, lon = FRAME.latlon_from_en(np.array(place_en_m))
    place = {"lat_deg": float(lat), "lon_deg": float(lon), "cov_en_m2": np.eye(2) * 4.0}
    about = {"confidence": 0.95, "radius_m": 35.0, "heading_deg": 30.0, "agl_m": 250.0}
    return Fix(**place, **about, evidence=evidence)


@pytest.fixture
def flown():
    camera = np.array([100.0, -50.0])
    level = level_telemetry(TRUE, np.random.default_rng(1))
    view = View(np.zeros((240, 320), np.uint8), CAMERA, level)
    return Flown(view, TRUE, camera, camera + axis_on_ground_en_m(*ATTITUDE, 250.0))


def test_the_telemetry_says_nothing_of_the_tilt(flown):
    reported = flown.view.telemetry
    assert (reported.pitch_deg, reported.roll_deg, reported.tilt_std_deg) == (0.0, 0.0, None)
    assert reported.yaw_std_deg == 10.0 and reported.agl_std_m == pytest.approx(25.0)
    assert reported.yaw_deg != TRUE.yaw_deg and reported.agl_m != TRUE.agl_m


def test_a_view_taken_as_level_is_off_by_its_tilt(flown):
    """The camera is placed above the middle of the picture, which is right."""
    placed = compared(fix_at(flown.middle_en_m), flown, FRAME)
    off_m = np.hypot(*(flown.middle_en_m - flown.camera_en_m))
    assert placed.error_m == pytest.approx(off_m, abs=0.01) and 20 < off_m < 23
    assert placed.middle_m == pytest.approx(0, abs=0.01)
    assert placed.nees == pytest.approx(off_m**2 / 4, rel=0.01)
    assert placed.share_of_height == pytest.approx(off_m / 250, rel=0.01) and not placed.is_wrong


def test_a_view_whose_tilt_is_found_is_right(flown):
    found = fix_at(flown.camera_en_m, pitch_bias_deg=4.0, roll_bias_deg=-3.0)
    placed = compared(found, flown, FRAME)
    assert (placed.error_m, placed.middle_m) == pytest.approx((0, 0), abs=0.01)


def test_the_height_gives_the_width():
    width, height = (root_agl_of(256, 1.5) * each for each in DEFAULT_CAMERA.extent)
    assert width * height == pytest.approx((256 * 1.5) ** 2)
