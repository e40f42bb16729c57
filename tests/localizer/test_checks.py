"""Views that cannot be placed are refused before any search; the least usable ones pass."""

import math
from dataclasses import replace

import numpy as np
import pytest

from orthonav.core.geo.camera import Camera
from orthonav.core.localize.rectify import RectifiedView
from orthonav.core.localize.view import check_picture, check_rectified, check_telemetry
from orthonav.core.records import Telemetry

CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
LEVEL = Telemetry(0, 90.0, 0.0, 0.0, 100.0)
GSD_M = 1.0


def reason(outcome):
    """The reason, None for a view that passes; detail is one sentence for people."""
    if outcome is None:
        return None
    assert len(outcome.detail) > 10 and "\n" not in outcome.detail
    return outcome.reason


def of_telemetry(camera=CAMERA, gsd_m=GSD_M, heading_known=True, **changes):
    return reason(check_telemetry(replace(LEVEL, **changes), camera, gsd_m, heading_known))


@pytest.mark.parametrize("name", ["yaw_deg", "pitch_deg", "roll_deg", "agl_m"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_missing_telemetry(name, value):
    telemetry = replace(LEVEL, **{name: value})
    outcome = check_telemetry(telemetry, CAMERA, GSD_M, True)
    assert reason(outcome) == "missing_telemetry" and name in outcome.detail
    unknown = check_telemetry(telemetry, CAMERA, GSD_M, False)
    assert reason(unknown) == (None if name == "yaw_deg" else "missing_telemetry")


@pytest.mark.parametrize(
    "agl_m, expected",
    [(-5, "bad_height"), (0, "bad_height"), (0.1, "too_small"), (21.5, "too_small"), (21.8, None)],
)
def test_height(agl_m, expected):
    """From 21.65 m the view covers 24 pixels across."""
    assert of_telemetry(agl_m=float(agl_m)) == expected
    assert of_telemetry(agl_m=float(agl_m) / 2, gsd_m=GSD_M / 2) == expected


@pytest.mark.parametrize(
    "pitch_deg, roll_deg, expected",
    [
        (64.9, 0, None),
        (65.1, 0, "extreme_tilt"),
        (-64.9, 0, None),
        (-65.1, 0, "extreme_tilt"),
        (0, 64.9, None),
        (0, -65.1, "extreme_tilt"),
        (49.4, 49.4, None),  # cos(49.454)^2 is cos(65)
        (49.5, 49.5, "extreme_tilt"),
        (90, 0, "extreme_tilt"),
        (0, 180, "extreme_tilt"),
        (180, 180, None),  # twice over is straight down again
        (360, -720, None),
    ],
)
def test_tilt(pitch_deg, roll_deg, expected):
    for yaw_deg in (0.0, 123.0):
        changes = {"pitch_deg": float(pitch_deg), "roll_deg": float(roll_deg)}
        assert of_telemetry(yaw_deg=yaw_deg, **changes) == expected


@pytest.mark.parametrize("width, height, expected", [(32, 32, None), (31, 900, "too_small")])
def test_small_cameras(width, height, expected):
    for size in ((width, height), (height, width)):
        camera = Camera(*size, 250.0, 250.0, 16.0, 16.0)
        assert of_telemetry(camera=camera, agl_m=200.0) == expected


@pytest.mark.parametrize("agl_m, expected", [(999.0, None), (1001.0, "too_coarse")])
def test_coarse_views(agl_m, expected):
    """From 1000 m a pixel covers 4 m."""
    assert of_telemetry(agl_m=agl_m) == expected
    assert of_telemetry(agl_m=agl_m * 2, gsd_m=2 * GSD_M) == expected
    assert of_telemetry(agl_m=agl_m / 40) is None  # fine views are thinned


def checks_of(low, high, share=0.5):
    """Grey levels (240, 320) of two kinds in squares of 16 px."""
    rows, cols = np.indices((240, 320)) // 16
    return np.where((rows * 20 + cols) % 10 < 10 * share, low, high).astype(np.uint8)


@pytest.mark.parametrize(
    "low, high, share, expected",
    [
        (0, 255, 0.5, None),
        (0, 0, 0.5, "too_dark"),
        (0, 15, 0.5, "too_dark"),
        (0, 16, 0.5, None),
        (0, 255, 0.9, None),
        (251, 255, 0.5, "too_bright"),
        (250, 255, 0.5, "blank"),
        (250, 255, 0.0, "too_bright"),
        (240, 255, 0.5, None),
        (128, 128, 0.5, "blank"),
        (125, 130, 0.5, "blank"),  # standard deviation 2.5
        (122, 129, 0.5, None),  # 3.5
    ],
)
def test_views_that_show_nothing(low, high, share, expected):
    assert reason(check_picture(checks_of(low, high, share))) == expected


def test_a_few_hot_pixels_make_no_view():
    grey = np.zeros((240, 320), np.uint8)
    grey[100:104, 100:108] = 255
    assert reason(check_picture(grey)) == "too_dark"
    assert reason(check_picture(255 - grey)) == "too_bright"


def rectified(valid, grey=None):
    grey = checks_of(40, 200)[:240, :240] if grey is None else grey
    return RectifiedView(grey, valid, np.zeros(2))


@pytest.mark.parametrize("seen, expected", [(0, "too_small"), (23, "too_small"), (24, None)])
def test_too_little_of_a_tile(seen, expected):
    valid = np.zeros((240, 240), bool)
    valid[:seen] = True
    assert reason(check_rectified(rectified(valid), 0.1)) == expected
    assert reason(check_rectified(rectified(valid), 0.0)) == (None if seen else "too_small")


def test_what_is_seen_is_uniform():
    valid = np.zeros((240, 240), bool)
    valid[100:] = True
    for step, expected in ((2, "blank"), (4, None)):  # standard deviation 1 and 2 of 1.5 needed
        grey = np.where(np.arange(240)[:, None] < 100, 0, 100) + step * (np.arange(240) % 2)
        view = rectified(valid, grey.astype(np.uint8))
        assert reason(check_rectified(view, 0.1)) == expected
