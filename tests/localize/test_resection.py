"""Position, height and attitude from single views whose tilt is not reported."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from blots import AGL_M, CAMERA, GROUND, Flat, as_grey, rendered

from orthonav.core.geo.camera import Camera
from orthonav.core.localize import Localizer, resection
from orthonav.core.localize.camera import camera_of
from orthonav.core.localize.ground import GroundModel
from orthonav.core.localize.resection import _Marginal
from orthonav.core.localize.search import Search
from orthonav.core.records import Fix, Prior, Telemetry, View

VIEWS, TILT_DEG = 24, 4.0
YAW_STD_DEG, AGL_STD = 5.0, 0.05


@pytest.fixture(scope="module")
def without_terrain(opened):
    """Without the displacement between dates: map and views show the same ground."""
    made = Localizer(opened)
    made.registration.floor_px = 0.0
    return made


@pytest.fixture(scope="module")
def localizer(opened):
    """The same on a map with a surface model."""
    made = Localizer(opened)
    made.registration.floor_px = 0.0
    made.registration.ground = GroundModel(Flat(), made.grid, surface=Flat())
    return made


def error_en_m(localizer, fix, place):
    assert isinstance(fix, Fix), fix
    return localizer.sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg) - place


def error(localizer, fix, place, attitude, agl_m):
    """Errors (6,): metres east, north and up, degrees of heading, pitch and roll."""
    turned = math.remainder(fix.heading_deg - attitude[0], 360)
    tilt = fix.pitch_deg - attitude[1], fix.roll_deg - attitude[2]
    return np.array([*error_en_m(localizer, fix, place), fix.agl_m - agl_m, turned, *tilt])


@pytest.fixture(scope="module")
def tilted(localizer):
    """Fixes of views tilted by 4 deg to all sides and reported level, and their errors.

    The views are unevenly lit, and the ground has changed: blots of several pixels were added.
    """
    rng, found = np.random.default_rng(3), []
    for number in range(VIEWS):
        place, agl_m = rng.uniform(-140, 140, 2), AGL_M * rng.uniform(0.9, 1.1)
        to = 2 * math.pi * number / VIEWS
        attitude = rng.uniform(0, 360), TILT_DEG * math.cos(to), TILT_DEG * math.sin(to)
        grey = 128 + (rendered(GROUND, place, attitude, agl_m) - 128.0) * np.linspace(0.6, 1.2, 320)
        blots = cv2.GaussianBlur(rng.normal(0, 1, grey.shape), (0, 0), 4.0)
        grey += 15 * blots / blots.std() + rng.normal(0, 5, grey.shape)
        reported = Telemetry(
            *(0, attitude[0] + rng.normal(0, YAW_STD_DEG), 0.0, 0.0), agl_m * rng.normal(1, AGL_STD)
        )
        lat, lon = localizer.sheet.frame.latlon_from_en(place + rng.normal(0, 10, 2))
        prior = Prior(float(lat), float(lon), 20.0)
        fix = localizer.locate(View(as_grey(grey), CAMERA, reported), prior=prior)
        found.append((fix, error(localizer, fix, place, attitude, agl_m), agl_m))
    return found


def test_unreported_tilt_is_found(tilted):
    for fix, off, agl_m in tilted:
        assert np.hypot(*off[:2]) < 0.01 * agl_m and fix.confidence > 0.9
        assert np.abs(off[4:]).max() < 0.4
        assert abs(off[2]) < 0.005 * agl_m and abs(off[3]) < 0.2
        assert fix.bias.pitch_bias_deg == pytest.approx(fix.pitch_deg)


def test_covariances_are_consistent(tilted):
    """Squares of normalized errors are below 1 on average: covariances are made for other dates,
    whose errors are more alike from block to block than those of blots."""
    place = [off[:2] @ np.linalg.solve(fix.cov_en_m2, off[:2]) / 2 for fix, off, _ in tilted]
    whole = [off @ np.linalg.solve(fix.pose_cov, off) / 6 for fix, off, _ in tilted]
    assert 0.1 < np.mean(place) < 3 and 0.1 < np.mean(whole) < 3
    for fix, _, _ in tilted:
        np.testing.assert_array_equal(fix.pose_cov[:2, :2], fix.cov_en_m2)
        np.testing.assert_allclose(fix.pose_cov, fix.pose_cov.T, atol=1e-12)
        assert np.linalg.eigvalsh(fix.pose_cov).min() > 0


def test_the_ground_seen_is_known_better_than_the_camera(tilted, localizer):
    for fix, _, _ in tilted:
        ground, camera = (np.trace(each) for each in (fix.ground_cov_en_m2, fix.cov_en_m2))
        assert ground < 0.5 * camera


def narrow_fix(localizer, focal_px, **reported):
    """The fix of a hardly textured view of 150 m of ground through a long lens, tilted by 3 deg."""
    camera, agl_m = Camera(320, 240, focal_px, focal_px, 160.0, 120.0), AGL_M * focal_px / 320
    away = agl_m * math.tan(math.radians(3.0))
    grey = rendered(GROUND, (20.0, -30.0 - away), (0.0, 3.0, 0.0), agl_m, camera)
    noise = np.random.default_rng(0).normal(0, 60, grey.shape)
    telemetry = Telemetry(0, 2.0, 0.0, 0.0, 1.02 * agl_m, **reported)
    return localizer.locate(View(as_grey(grey + noise), camera, telemetry)), agl_m


def test_a_view_that_does_not_show_its_tilt_keeps_the_doubt_of_the_report(localizer, monkeypatch):
    """Through a long lens, tilt hardly shows; its doubt moves the camera, not the ground seen."""
    fix, agl_m = narrow_fix(localizer, 6000.0)
    doubt_m = agl_m * math.tan(math.radians(3.0))
    stds = np.sqrt(np.diag(fix.cov_en_m2))
    assert (stds > 0.5 * doubt_m).all() and (stds < 1.2 * doubt_m).all()
    assert np.sqrt(np.diag(fix.ground_cov_en_m2)).max() < 0.02 * doubt_m
    assert fix.radius_m == pytest.approx(0.025 * agl_m, rel=0.05) and fix.confidence < 0.8
    known, _ = narrow_fix(localizer, 6000.0, tilt_std_deg=0.3)
    assert np.sqrt(np.diag(known.cov_en_m2)).max() < 0.12 * doubt_m and known.confidence > 0.9
    monkeypatch.setattr(localizer.registration, "radius_m", 4 * doubt_m)
    assert narrow_fix(localizer, 6000.0)[0].confidence > 0.9


def test_exact_pitch_and_roll_stay(localizer):
    place, attitude = np.array([-30.0, 50.0]), (70.0, 6.0, -4.0)
    grey = rendered(GROUND, place, attitude)
    reported = Telemetry(0, 73.0, *attitude[1:], 1.03 * AGL_M, tilt_std_deg=0.0)
    fix = localizer.locate(View(grey, CAMERA, reported))
    assert np.hypot(*error_en_m(localizer, fix, place)) < 0.1
    assert (fix.pitch_deg, fix.roll_deg) == pytest.approx(attitude[1:], abs=0.05)
    assert np.sqrt(np.diag(fix.cov_en_m2)).max() < 0.5
    # Where they are wrong, the camera is as far off.
    wrong = Telemetry(0, 73.0, 9.0, -4.0, AGL_M, tilt_std_deg=0.0)
    off = error_en_m(localizer, localizer.locate(View(grey, CAMERA, wrong)), place)
    assert np.hypot(*off) == pytest.approx(AGL_M * math.radians(3.0), rel=0.25)


def test_tilt_of_an_oblique_view_is_found(localizer):
    place, attitude = np.array([-60.0, -150.0]), (20.0, 57.0, 2.0)
    grey = rendered(GROUND, place, attitude, 100.0)
    fix = localizer.locate(View(grey, CAMERA, Telemetry(0, 22.0, 54.0, 4.0, 102.0)))
    off = error(localizer, fix, place, attitude, 100.0)
    assert np.hypot(*off[:2]) < 1.0 and np.abs(off[4:]).max() < 0.4
    assert fix.confidence > 0.9


@pytest.mark.parametrize("variance", [0.25, 1.0, 2.8])
def test_errors_of_blocks_scale_all_but_what_telemetry_says(variance):
    # Shown by the picture; by telemetry only; by both alike.
    shown, reported = np.array([1e4, 0.0, 3.0]), np.array([0.0, 0.2, 3.0])
    marginal = _Marginal(np.diag(shown), np.zeros((3, 3)))
    scaled = np.diag(marginal.covariance(np.diag(reported), variance))
    assert scaled[:2] == pytest.approx([variance * 1e-4, 5.0])
    # A mean of two errors with standard deviations of sqrt(variance / 3) and sqrt(1 / 3).
    assert scaled[2] == pytest.approx((variance / 3 + 1 / 3) / 4)


def test_systematic_errors_are_marginalized():
    """As in the covariance of all unknowns."""
    rng = np.random.default_rng(1)
    slopes = rng.normal(size=(40, 9))
    curvature, information = slopes.T @ slopes, np.eye(9)
    telemetry = np.diag([0.0, 0.0, 1.0, 1.0, 4.0, 4.0])
    information[:6, :6] = telemetry
    marginal = _Marginal.of(curvature, information)
    every = np.linalg.inv(curvature + information)
    noise, known = every @ curvature @ every, every @ information @ every
    np.testing.assert_allclose(
        marginal.covariance(telemetry, 1.7), (1.7 * noise + known)[:6, :6], rtol=1e-9
    )


def test_a_place_that_stands_out_is_known_better(localizer, monkeypatch):
    none = (1e-3, 10.0)  # noise of blocks alone
    errors = replace(resection.ERRORS, surface_m=none, stretch_px=none)
    monkeypatch.setattr(resection, "ERRORS", errors)
    attitude = (20.0, 0.0, 0.0)
    view = View(
        as_grey(rendered(GROUND, np.zeros(2), attitude, AGL_M)),
        CAMERA,
        Telemetry(0, *attitude, AGL_M),
    )
    search, best = Search.of(localizer.registration, view).run()
    alike, alone = (
        camera_of(search.over_ground, best.place.window_pose, ratio, 0.0) for ratio in (1.0, 10.0)
    )
    assert (alone.orientation.position_m == alike.orientation.position_m).all()
    stds = [np.sqrt(np.trace(each.covariance[:2, :2])) for each in (alone, alike)]
    assert 0.3 < stds[0] / stds[1] < 0.7


def test_a_slope_that_no_terrain_states_is_no_tilt(without_terrain, localizer):
    """The same picture: over unknown ground half of what it shows may be the ground's slope; with
    a terrain it is tilt."""
    attitude = 40.0, 3.0, -2.0
    grey = rendered(GROUND, np.zeros(2), attitude)

    def fix(localizer, std_deg=None):
        telemetry = Telemetry(0, 40.0, 0.0, 0.0, AGL_M, tilt_std_deg=std_deg)
        return localizer.locate(View(grey, CAMERA, telemetry))

    known, unknown = fix(localizer), fix(without_terrain)
    assert (known.pitch_deg, known.roll_deg) == pytest.approx(attitude[1:], abs=0.3)
    assert 1.2 < unknown.pitch_deg < 2.7 and -1.8 < unknown.roll_deg < -0.8
    std_m = math.sqrt(unknown.pose_cov[0, 0])
    assert 0.015 * AGL_M < std_m < 0.045 * AGL_M
    off_m = np.hypot(*error_en_m(without_terrain, unknown, np.zeros(2)))
    assert off_m < 2 * std_m
    # A tilt that is stated keeps its weight over unknown ground only.
    stated, over_known = fix(without_terrain, 0.5), fix(localizer, 0.5)
    assert abs(stated.pitch_deg) < 0.4 and math.sqrt(stated.cov_en_m2[0, 0]) < 0.012 * AGL_M
    assert over_known.pitch_deg > 1.5
