"""The tile localizer: views found, limited by the prior, or refused with a reason."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from blots import error_m, place_of, prior_at
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from orthonav.core.errors import CameraError
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Fix, NoFix, Prior, Telemetry, View
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area
from orthonav.ground.simulate.render import ViewEffects, render_view

EVIDENCE = {"score", "margin", "lowe_ratio", "peak_ratio", "tiles_searched", "valid_share"}
PLAIN = ViewEffects(exposure_std=0.0, blur_px=0.0, noise_std=0.0)
GROUND_M = 420


@pytest.fixture(scope="module")
def views(flight):
    """Views of the second date by frame."""
    return {each.frame: View(each.grey(), flight.camera, each.telemetry) for each in flight.views}


@pytest.fixture(scope="module")
def fixes(views, localizer):
    """Their fixes, without any prior."""
    return {name: localizer.locate(view) for name, view in views.items()}


@pytest.fixture(scope="module")
def good(views, fixes, localizer, truth_en_m):
    """The view that is placed best."""
    return views[min(fixes, key=lambda name: error_m(localizer, fixes[name], truth_en_m[name]))]


class Ground:
    """The first date, to be seen with any attitude."""

    def __init__(self, area, localizer):
        outline = Mosaic.open([area.past]).outline_latlon_deg
        extent = Area.from_outline(outline[:, 0], outline[:, 1])
        self.offset = localizer.sheet.frame.en_from_latlon(
            extent.frame.lat_deg, extent.frame.lon_deg
        )
        assert np.hypot(*self.offset) < 0.1  # the map is of the whole imagery: the same plane
        self.camera, self.agl_m = area.camera, area.agl_m
        self.mosaic, self.frame = Mosaic.open([area.past]), localizer.sheet.frame

    def view(self, east_m, north_m, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0):
        """A view from that place."""
        west, north = east_m - GROUND_M, north_m + GROUND_M
        sheet = self.mosaic.sheet(
            self.frame,
            west_m=west,
            north_m=north,
            width_px=2 * GROUND_M,
            height_px=2 * GROUND_M,
            gsd_m=1.0,
        )
        with sheet:
            rgb = sheet.read(0, 0, 2 * GROUND_M, 2 * GROUND_M).rgb
        attitude = (yaw_deg, pitch_deg, roll_deg, self.agl_m)
        corner = np.array([-GROUND_M, GROUND_M], float)
        rng = np.random.default_rng(0)
        picture = render_view(self.camera, attitude, rgb, corner, 1.0, PLAIN, rng)
        grey = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
        return View(grey, self.camera, Telemetry(0, *attitude))


@pytest.fixture(scope="module")
def ground(area, localizer):
    return Ground(area, localizer)


def reported(view, **changes):
    return replace(view, telemetry=replace(view.telemetry, **changes))


def test_most_views_of_another_date_are_placed(fixes, localizer, truth_en_m):
    errors = [error_m(localizer, fix, truth_en_m[name]) for name, fix in fixes.items()]
    assert np.mean(np.array(errors) <= localizer.grid.stride_m) >= 0.9
    right = [fix.confidence for fix, off in zip(fixes.values(), errors, strict=True) if off < 40]
    assert np.median(right) > 0.5


def test_a_fix_states_its_evidence(views, fixes, localizer):
    for frame, view in views.items():
        fix = fixes[frame]
        assert isinstance(fix, Fix) and set(fix.evidence) >= EVIDENCE
        assert all(math.isfinite(value) for value in fix.evidence.values())
        assert fix.evidence["tiles_searched"] == localizer.sheet.tiles
        assert 0 < fix.evidence["valid_share"] <= 1 and -1 <= fix.evidence["score"] <= 1.001
        assert fix.evidence["peak_ratio"] >= fix.evidence["lowe_ratio"] >= 1
        assert 0 <= fix.confidence <= 1 and fix.radius_m == localizer.radius_m
        assert fix.agl_m == view.telemetry.agl_m
        turned = (fix.heading_deg - view.telemetry.yaw_deg + 180) % 360 - 180
        assert 0 <= fix.heading_deg < 360 and abs(turned) < 20
        assert np.linalg.eigvalsh(fix.cov_en_m2).min() > 0
        with pytest.raises(TypeError):
            fix.evidence["score"] = 1.0


def test_a_prior_outside_the_map(localizer, good):
    for place in ([50_000.0, 0.0], [0.0, -3000.0]):
        outcome = localizer.locate(good, prior=prior_at(localizer, place, 100.0))
        assert isinstance(outcome, NoFix) and outcome.reason == "outside_map"


def test_unknown_heading(ground, localizer):
    places = [(-150.0, 40.0), (60.0, -30.0), (170.0, 100.0), (0.0, 0.0), (-60.0, -90.0)]
    found = 0
    for place in places:
        view = reported(ground.view(*place, yaw_deg=137.0), yaw_deg=math.nan)
        fix = localizer.locate(view, heading_known=False)
        assert isinstance(fix, Fix)
        right = error_m(localizer, fix, np.array(place)) <= localizer.grid.stride_m
        found += right
        if right:
            assert abs((fix.heading_deg - 137 + 180) % 360 - 180) <= 8
        refused = localizer.locate(view)
        assert refused.reason == "missing_telemetry" and "yaw_deg" in refused.detail
    assert found >= 4


@pytest.mark.parametrize("attitude", [(0, 15, -10), (75, 15, -10), (200, -12, 14), (0, 0, 25)])
def test_tilt_is_compensated(ground, localizer, attitude):
    place = np.array([40.0, -10.0])
    level = localizer.locate(ground.view(*place, float(attitude[0])))
    tilted = localizer.locate(ground.view(*place, *map(float, attitude)))
    assert error_m(localizer, level, place) <= localizer.grid.stride_m
    apart = place_of(localizer, level) - place_of(localizer, tilted)
    assert np.abs(apart).max() <= localizer.grid.stride_m


REFUSED_TELEMETRY = [
    ({"yaw_deg": math.nan}, "missing_telemetry"),
    ({"pitch_deg": math.nan}, "missing_telemetry"),
    ({"roll_deg": math.inf}, "missing_telemetry"),
    ({"agl_m": math.nan}, "missing_telemetry"),
    ({"agl_m": 0.0}, "bad_height"),
    ({"agl_m": -120.0}, "bad_height"),
    ({"agl_m": 1e7}, "too_coarse"),
    ({"agl_m": 1e300}, "too_coarse"),
    ({"agl_m": 0.5}, "too_small"),
    ({"agl_m": 1e-300}, "too_small"),
    ({"agl_m": 5e-324}, "too_small"),
    ({"pitch_deg": 80.0}, "extreme_tilt"),
    ({"roll_deg": -80.0}, "extreme_tilt"),
    ({"pitch_deg": 180.0}, "extreme_tilt"),
]


@pytest.mark.parametrize("changes, reason", REFUSED_TELEMETRY)
def test_telemetry_that_makes_no_fix(localizer, good, changes, reason):
    outcome = localizer.locate(reported(good, **changes))
    assert isinstance(outcome, NoFix) and outcome.reason == reason
    assert outcome.detail and "\n" not in outcome.detail


@pytest.mark.parametrize(
    "grey, reason",
    [
        (np.full((240, 320), 128, np.uint8), "blank"),
        (np.zeros((240, 320), np.uint8), "too_dark"),
        (np.full((240, 320), 255, np.uint8), "too_bright"),
        (np.full((16, 16), 99, np.uint8), "too_small"),
        (np.zeros((1, 1), np.uint8), "too_small"),
    ],
)
def test_pictures_that_make_no_fix(localizer, grey, reason):
    height, width = grey.shape
    camera = Camera(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
    outcome = localizer.locate(View(grey, camera, Telemetry(0, 0.0, 0.0, 0.0, 300.0)))
    assert isinstance(outcome, NoFix) and outcome.reason == reason


def test_a_picture_that_is_turned_in_memory_is_one_like_any_other(localizer, good):
    """As of a camera mounted upside down: `image[::-1, ::-1]` is no copy."""
    grey = cv2.resize(good.grey, None, fx=4, fy=4)
    turned = np.ascontiguousarray(grey[::-1, ::-1])[::-1, ::-1]
    one, other = (
        localizer.locate(View(each, good.camera, good.telemetry)) for each in (grey, turned)
    )
    assert (one.lat_deg, one.lon_deg) == (other.lat_deg, other.lon_deg)


@pytest.mark.parametrize("shape", [(240, 300), (320, 240), (480, 320)])
def test_a_camera_of_another_aspect_ratio_is_an_error(flight, shape):
    telemetry = Telemetry(0, 0.0, 0.0, 0.0, 300.0)
    with pytest.raises(CameraError, match=f"320 x 240 px, the image is {shape[1]} x {shape[0]}"):
        View(np.zeros(shape, np.uint8), flight.camera, telemetry)


anything = st.floats(allow_nan=True, allow_infinity=True)


def mostly(usual):
    """Mostly sane values, so that what follows the first checks is reached too."""
    return st.one_of(usual, usual, usual, usual, usual, anything)


telemetry = st.builds(
    Telemetry,
    time_ns=st.just(0),
    yaw_deg=mostly(st.floats(-400, 400)),
    pitch_deg=mostly(st.floats(-46, 46)),
    roll_deg=mostly(st.floats(-40, 40)),
    agl_m=mostly(st.floats(100, 2000)),
    yaw_std_deg=st.none() | mostly(st.floats(0, 40)),
    agl_std_m=st.none() | anything,
)
priors = st.none() | st.builds(
    Prior,
    lat_deg=st.floats(48.85, 48.87) | st.floats(-90, 90),
    lon_deg=st.floats(2.34, 2.36) | st.floats(-360, 360),
    std_m=st.floats(0, 1000) | st.floats(0),
)


@settings(
    max_examples=30,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(telemetry=telemetry, prior=priors, heading_known=st.booleans() | st.just(True))
def test_no_telemetry_raises(localizer, good, telemetry, prior, heading_known):
    view = View(good.grey, good.camera, telemetry)
    outcome = localizer.locate(view, prior=prior, heading_known=heading_known)
    if isinstance(outcome, NoFix):
        assert outcome.reason and outcome.detail
        return
    assert isinstance(outcome, Fix)
    assert math.isfinite(outcome.lat_deg) and math.isfinite(outcome.lon_deg)
    assert abs(outcome.lat_deg) <= 90 and abs(outcome.lon_deg) <= 180
    assert 0 <= outcome.heading_deg <= 360 and math.isfinite(outcome.agl_m)
    assert np.isfinite(outcome.cov_en_m2).all() and 0 <= outcome.confidence <= 1
    assert all(math.isfinite(value) for value in outcome.evidence.values())
