"""Coordinates of pixels: against lines of sight, and ellipses against errors."""

import math
from dataclasses import replace

import numpy as np
import pytest

from orthonav.core.errors import FlightError
from orthonav.core.geo.camera import Camera, ground_en_m
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.records import Fix, Telemetry
from orthonav.ground.recordings.pixel import locate_pixel

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
FRAME = LocalFrame(48.0, 2.0)
AGL_M = 200.0
STDS = {"heading_std_deg": 0.8, "log_scale_std": 0.01}


def telemetry(pitch_deg=0.0, roll_deg=0.0):
    return Telemetry(0, 0.0, pitch_deg, roll_deg, AGL_M)


def fix(east_m=0.0, north_m=0.0, heading_deg=30.0, agl_m=AGL_M, std_m=1.0, **stated):
    lat, lon = FRAME.latlon_from_en([east_m, north_m])
    covariance = np.eye(2) * std_m**2
    place = float(lat), float(lon), covariance
    return Fix(*place, 0.99, 35.0, heading_deg, agl_m, **{**STDS, **stated})


def en_of(point):
    return np.asarray(FRAME.en_from_latlon(point.lat_deg, point.lon_deg))


def slope(lat_deg, lon_deg):
    """A plane that rises by 0.3 to the east, 100 m above sea below the camera."""
    east = FRAME.en_from_latlon(lat_deg, lon_deg)[..., 0]
    return 100.0 + 0.3 * east


@pytest.mark.parametrize("px", [(320, 240), (0, 0), (640, 100), (123.5, 400.25)])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (12.0, -7.0)])
def test_on_level_ground_it_is_where_the_line_of_sight_ends(px, tilt):
    found = locate_pixel(CAMERA, telemetry(*tilt), fix(), px)
    wanted = ground_en_m(CAMERA, np.array([px]), 30.0, *tilt, AGL_M)[0]
    np.testing.assert_allclose(en_of(found), wanted, atol=1e-3)
    assert math.isnan(found.height_m)
    assert found.range_m == pytest.approx(math.hypot(*wanted, AGL_M))


@pytest.mark.parametrize("px", [(320, 240), (0, 0), (640, 480)])
def test_on_a_slope_it_is_where_the_line_of_sight_meets_it(px):
    found = locate_pixel(CAMERA, telemetry(5.0, 3.0), fix(), px, slope)
    direction = ground_en_m(CAMERA, np.array([px]), 30.0, 5.0, 3.0, 1.0)[0]
    drop = AGL_M / (1 + 0.3 * direction[0])  # AGL - drop = 0.3 east
    np.testing.assert_allclose(en_of(found), direction * drop, atol=0.02)
    assert found.height_m == pytest.approx(100 + 0.3 * direction[0] * drop, abs=0.02)


MIDDLE = 320.0, 240.0


def ground(px, heading_deg=30.0, agl_m=AGL_M, tilt_deg=(0.0, 0.0)):
    """Metres east and north (2,) of the camera of what it shows at a pixel."""
    return ground_en_m(CAMERA, np.array([px]), heading_deg, *tilt_deg, agl_m)[0]


def share_inside(located, true_en_m):
    """Fraction of these points whose 95 % ellipse holds the true one."""
    off = [(en_of(point) - true_en_m, point.cov_en_m2) for point in located]
    return np.mean([each @ np.linalg.solve(cov, each) < 5.991 for each, cov in off])


@pytest.mark.parametrize(
    ("px", "tilt_deg"),
    [
        ((320, 240), 0.0),
        pytest.param((320, 240), 25.0, marks=pytest.mark.slow),
        pytest.param((20, 30), 0.0, marks=pytest.mark.slow),
        ((20, 30), 25.0),
    ],
)
def test_ellipses_cover_what_they_state(px, tilt_deg):
    """The middle of the view is measured, the camera follows from it."""
    rng, tilt = np.random.default_rng(4), (tilt_deg, 0.0)
    tilted = replace(telemetry(tilt_deg), tilt_std_deg=0.0)
    heading_std, scale_std = math.radians(0.8), 0.01
    at_camera = ground(MIDDLE, tilt_deg=tilt)
    lever = np.outer(at_camera, at_camera) * scale_std**2
    lever += np.outer(at_camera[::-1] * [1, -1], at_camera[::-1] * [1, -1]) * heading_std**2
    assert np.trace(lever) == pytest.approx(at_camera @ at_camera * (scale_std**2 + heading_std**2))

    def located():
        heading = 30.0 + math.degrees(rng.normal(0, heading_std))
        agl_m = AGL_M * math.exp(rng.normal(0, scale_std))
        place = rng.normal(0, 1.0, 2) + at_camera - ground(MIDDLE, heading, agl_m, tilt)
        seen = fix(*place, heading_deg=heading, agl_m=agl_m, ground_cov_en_m2=np.eye(2))
        return locate_pixel(CAMERA, tilted, replace(seen, cov_en_m2=np.eye(2) + lever), px)

    share = share_inside([located() for _ in range(300)], ground(px, tilt_deg=tilt))
    assert 0.92 < share < 0.975


def near(lat_deg, lon_deg):
    far = np.hypot(*np.moveaxis(FRAME.en_from_latlon(lat_deg, lon_deg), -1, 0)) > 20
    return np.where(far, np.nan, 0.0)


@pytest.mark.parametrize(
    ("px", "pitch_deg", "terrain", "words"),
    [
        ((641, 5), 0.0, None, "outside the picture of 640 x 480"),
        ((320, 10), 80.0, None, "no ground that is known"),
        ((0, 0), 0.0, lambda lat, lon: lat * np.nan, "under the camera"),
        ((0, 0), 0.0, near, "no ground that is known"),
    ],
)
def test_pixels_that_show_no_ground_are_refused(px, pitch_deg, terrain, words):
    with pytest.raises(FlightError, match=words):
        locate_pixel(CAMERA, telemetry(pitch_deg), fix(), px, terrain)


@pytest.mark.parametrize("pitch_deg", [0.0, 30.0])
def test_the_middle_is_as_exact_as_registration_where_tilt_is_uncertain(pitch_deg):
    """The covariance of the camera holds the tilt, that of the middle of the view does not."""
    tilted = replace(telemetry(pitch_deg), tilt_std_deg=3.0)
    lever_m = 1.05 * AGL_M * math.radians(3.0) / math.cos(math.radians(pitch_deg)) ** 2
    exact = {"heading_std_deg": 0.0, "log_scale_std": 0.0}
    seen = replace(
        fix(agl_m=1.05 * AGL_M, **exact, ground_cov_en_m2=np.eye(2) * 0.6**2),
        cov_en_m2=np.eye(2) * (0.6**2 + lever_m**2),
    )
    found = locate_pixel(CAMERA, tilted, seen, (320, 240))
    np.testing.assert_allclose(found.cov_en_m2, np.eye(2) * 0.6**2, atol=1e-9)
    # A fix that does not say how well the middle is known is one of the camera.
    found = locate_pixel(CAMERA, tilted, replace(seen, ground_cov_en_m2=None), (320, 240))
    assert (np.linalg.eigvalsh(found.cov_en_m2 - seen.cov_en_m2) > 0).all()


@pytest.mark.parametrize("px", [(320, 240), (20, 30)])
def test_a_fix_that_states_its_camera_moves_a_pixel_by_all_six(px):
    """Errors of position and tilt that belong together leave the ground seen where it is."""
    camera_std = np.array([4.0, 4.0, 2.0, 0.3, 1.0, 1.0])

    def seen_at(camera):
        east, north, up, heading, *tilt = camera
        return np.add([east, north], ground(MIDDLE, 30.0 + heading, AGL_M + up, tilt))

    # What the middle shows is known to 0.5 m: the covariance of a camera given that.
    step = 1e-3
    slopes = np.stack([seen_at(e) - seen_at(-e) for e in np.eye(6) * step], axis=1) / (2 * step)
    covariance = np.linalg.inv(np.diag(camera_std**-2) + slopes.T @ slopes / 0.5**2)

    def located(error):
        east, north, up, heading, pitch, roll = error
        seen = fix(east, north, 30.0 + heading, AGL_M + up)
        seen = replace(seen, pitch_deg=pitch, roll_deg=roll, pose_cov=covariance)
        return locate_pixel(CAMERA, telemetry(9.0, 9.0), seen, px)  # not the reported tilt

    # Eigenvectors, the default, have other signs on other processors.
    draw = np.random.default_rng(5).multivariate_normal
    found = [located(error) for error in draw(np.zeros(6), covariance, 300, method="cholesky")]
    assert 0.92 < share_inside(found, ground(px)) < 0.975
    # Less is known of the camera's place than of the ground, most of all in the middle.
    share = 0.05 if px == (320, 240) else 0.5
    assert np.trace(found[-1].cov_en_m2) < share * np.trace(covariance[:2, :2])
