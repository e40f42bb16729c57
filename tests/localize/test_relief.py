"""Views of relief on a map with a terrain, against rays that are followed to the ground."""

import math
from dataclasses import replace

import numpy as np
import pytest
from blots import (
    AGL_M,
    CAMERA,
    FINEST_M,
    GROUND,
    ROUGH,
    Flat,
    Heights,
    as_grey,
    error_m,
    planned,
    rendered,
)
from lab.terrain import random_relief, seen_view

from orthonav.core.geo.ground import Ground
from orthonav.core.localize import Localizer
from orthonav.core.localize.camera import FITTING
from orthonav.core.localize.confidence import MAX_RATIO
from orthonav.core.localize.ground import GroundModel, ViewOverGround
from orthonav.core.localize.place import MidPlace
from orthonav.core.localize.plan import ClearMargin
from orthonav.core.localize.resection import ERRORS
from orthonav.core.localize.search import Search, prepared_view
from orthonav.core.localize.view import Orientation
from orthonav.core.records import Fix, Telemetry, View
from orthonav.core.register.window import Pose
from orthonav.ground.simulate.render import Raster

SIDE_M, POSTING_M = 700.0, 10.0
PLACE = np.array([30.0, -40.0])
ATTITUDE = (70.0, 4.0, -3.0)
BASE_M = 100.0


@pytest.fixture(scope="module")
def grey():
    at = np.arange(FINEST_M / 2, SIDE_M, FINEST_M) - SIDE_M / 2
    east, north = np.meshgrid(at, -at)
    made = as_grey(GROUND(east, north)).astype(np.float32)
    return Raster(made, -SIDE_M / 2, SIDE_M / 2, FINEST_M)


def hills(slope):
    side = int(SIDE_M / POSTING_M)
    made = random_relief((side, side), POSTING_M, slope, 120.0, 3) + np.float32(BASE_M)
    return Raster(made, -SIDE_M / 2, SIDE_M / 2, POSTING_M)


@pytest.fixture(scope="module")
def relief():
    return hills(0.3)


def on_terrain(opened, relief):
    localizer = Localizer(opened)
    localizer.registration.ground = GroundModel(Heights(relief), localizer.grid, surface=Flat())
    return localizer


def seen_from(grey, relief, attitude=ATTITUDE, agl_m=AGL_M, place=PLACE):
    """A view, and the position (3,) of its camera."""
    below = float(relief.at(place[:1], place[1:])[0])
    position = np.array([*place, below + agl_m])
    picture, _ = seen_view(grey, relief, CAMERA, attitude, position, finer=1)
    return picture, position


def telemetry(attitude=ATTITUDE, agl_m=AGL_M, **more):
    return Telemetry(0, *attitude, agl_m, **more)


def test_a_view_of_hills_is_placed_as_one_of_level_ground(opened, grey, relief):
    picture, _ = seen_from(grey, relief)
    view = View(picture, CAMERA, telemetry((73.0, 4.0, -3.0), AGL_M * 1.04))
    fix = (localizer := on_terrain(opened, relief)).locate(view)
    assert error_m(localizer, fix, PLACE) < 0.5 and fix.confidence > 0.9
    assert fix.agl_m == pytest.approx(AGL_M, rel=0.005)
    assert abs(math.remainder(fix.heading_deg - ATTITUDE[0], 360)) < 0.3
    level = (flat := Localizer(opened, level_ground=True)).locate(view)
    assert error_m(flat, level, PLACE) > 3 * error_m(localizer, fix, PLACE)
    assert fix.evidence["terrain_gain"] > 1.05 and fix.evidence["score"] > level.evidence["score"]
    assert "terrain_gain" not in level.evidence


def test_a_view_of_hills_is_placed_although_nothing_ends_its_search(opened, grey, relief):
    """After all stages candidates are compared on the terrain."""
    picture, _ = seen_from(grey, relief)
    localizer = on_terrain(opened, relief)
    never = ClearMargin(1e9, 1e9, 1e9)
    localizer.registration.plan = planned(
        clear=never, clear_at_mid=never, trial_clear=never, trial_doubt=0.0
    )
    view = View(picture, CAMERA, telemetry((73.0, 4.0, -3.0), AGL_M * 1.04))
    fix = localizer.locate(view)
    assert error_m(localizer, fix, PLACE) < 0.5 and fix.confidence > 0.9


@pytest.mark.parametrize("flat_scale", [-0.2, 0.0])
def test_a_place_is_found_on_the_terrain_at_the_scale_expected_there(
    opened, grey, relief, flat_scale
):
    """Whatever other scale fits flat ground."""
    picture, position = seen_from(grey, relief)
    registration = on_terrain(opened, relief).registration
    right = Search.of(registration, View(picture, CAMERA, telemetry())).best().place.window_pose
    ground_m = float(position[2]) - AGL_M * math.exp(right.log_scale)  # mean of the window
    agl_m = AGL_M * math.exp(-0.2)
    below = Ground(ground_m + AGL_M - agl_m, 1.0, 1.0)
    refiner = Search.of(
        registration, View(picture, CAMERA, telemetry(agl_m=agl_m, below=below))
    ).refiner
    fit = refiner.refined(replace(right, log_scale=flat_scale), refiner.levels.mid)
    (found,) = refiner.on_terrain([MidPlace(fit, fit.score)], 1)
    assert found.pose.distance_px(right) < 0.2
    assert found.pose.log_scale == pytest.approx(right.log_scale + 0.2, abs=0.01)


def test_the_height_is_counted_from_the_ground_below_the_camera(opened, relief):
    """The camera of a view far off nadir stays where it is."""
    attitude = (70.0, 30.0, -10.0)
    registration = on_terrain(opened, relief).registration
    picture = rendered(GROUND, PLACE, attitude)
    prepared = prepared_view(registration, View(picture, CAMERA, telemetry(attitude)), True)
    over_ground = ViewOverGround(registration.ground, prepared, registration.reference)
    pose = Pose(300.0, 290.0, 0.3, 0.05)
    below, camera = over_ground.below_camera(pose), over_ground.orientation(pose)
    np.testing.assert_allclose(over_ground.camera_en_m(below), camera.position_m[:2], atol=1e-6)
    above_m = camera.position_m[2] - float(relief.at(*camera.position_m[:2, None])[0])
    assert AGL_M * math.exp(below.log_scale) == pytest.approx(above_m, abs=0.1)
    assert abs(below.log_scale - pose.log_scale) > 0.01 and below.heading_rad == pose.heading_rad


def test_the_ground_seen_is_that_of_the_middle_of_the_picture(opened, grey, relief):
    attitude = (70.0, 20.0, 0.0)
    _, position = seen_from(grey, relief, attitude)
    picture, ground = seen_view(grey, relief, CAMERA, attitude, position, finer=1)
    localizer = on_terrain(opened, relief)
    fix = localizer.locate(View(picture, CAMERA, telemetry(attitude)))
    seen = localizer.sheet.frame.en_from_latlon(*fix.ground_latlon_deg)
    middle = ground[CAMERA.height_px // 2, CAMERA.width_px // 2]
    assert float(np.hypot(*(seen - middle[:2]))) < 2.0


def test_pitch_and_roll_are_estimated_unless_they_are_exact(opened, grey, relief):
    picture, _ = seen_from(grey, relief)
    off = (72.0, ATTITUDE[1] + 1.5, ATTITUDE[2] - 1.5)
    localizer = on_terrain(opened, relief)
    fixes = [
        localizer.locate(View(picture, CAMERA, telemetry(off, **known)))
        for known in ({"tilt_std_deg": 0.0}, {"tilt_std_deg": 1.5}, {})
    ]
    errors = [error_m(localizer, fix, PLACE) for fix in fixes]
    assert errors[0] > 3.5 and max(errors[1:]) < 0.3 * errors[0]
    assert (fixes[0].pitch_deg, fixes[0].roll_deg) == pytest.approx(off[1:], abs=0.2)
    for fix in fixes[1:]:
        assert (fix.pitch_deg, fix.roll_deg) == pytest.approx(ATTITUDE[1:], abs=0.4)
    # The ground in the middle is known better than the camera, but no better than maps agree where
    # a view stands out most.
    camera_m = math.sqrt(np.linalg.eigvalsh(fixes[1].cov_en_m2)[-1])
    floor_m = localizer.registration.floor_px * localizer.grid.gsd_m
    floor_m *= math.sqrt(FITTING.variance * MAX_RATIO**FITTING.variance_power)
    assert 0.99 * floor_m < fixes[1].evidence["middle_std_m"] < camera_m


@pytest.mark.parametrize("wrong", ["displaced", "50 m too high", "inside out"])
def test_a_wrong_terrain_gives_no_confident_wrong_position(opened, grey, relief, wrong):
    values = relief.values
    made = {
        "displaced": replace(relief, west_m=relief.west_m + 200.0),
        "50 m too high": replace(relief, values=values + np.float32(50)),
        "inside out": replace(relief, values=2 * values.mean() - values),
    }[wrong]
    picture, position = seen_from(grey, relief)
    below = Ground(float(made.values.mean()), float(made.values.std()), 1.0)
    agl_m = float(position[2] - below.height_m)
    own = math.hypot(0.08 * agl_m, below.std_m)
    view = View(picture, CAMERA, telemetry(agl_m=agl_m, agl_std_m=own, below=below))
    fix = (localizer := on_terrain(opened, made)).locate(view)
    assert (
        not isinstance(fix, Fix)
        or fix.confidence < 0.9
        or (error_m(localizer, fix, PLACE) < fix.radius_m)
    )
    if wrong == "inside out" and isinstance(fix, Fix):
        assert fix.evidence["terrain_gain"] <= 1


def test_holes_are_not_compared(opened, grey, relief):
    holed = replace(relief, values=relief.values.copy())
    holed.values[:, 38:] = np.nan
    picture, _ = seen_from(grey, relief)
    fix = (localizer := on_terrain(opened, holed)).locate(View(picture, CAMERA, telemetry()))
    assert not isinstance(fix, Fix) or fix.confidence < 0.9 or error_m(localizer, fix, PLACE) < 10
    nothing = replace(relief, values=np.full_like(relief.values, np.nan))
    fix = (localizer := on_terrain(opened, nothing)).locate(View(picture, CAMERA, telemetry()))
    level = Localizer(opened, level_ground=True).locate(View(picture, CAMERA, telemetry()))
    assert (fix.lat_deg, fix.lon_deg) == (level.lat_deg, level.lon_deg)


def test_the_camera_over_a_hole_of_the_terrain_is_found(opened, grey, relief):
    """Its height is that above the ground in the picture."""
    picture, _ = seen_from(grey, relief)
    col, row = np.rint((SIDE_M / 2 + PLACE * [1, -1]) / POSTING_M).astype(int)
    holed = replace(relief, values=relief.values.copy())
    holed.values[row - 1 : row + 2, col - 1 : col + 2] = np.nan
    fix = (localizer := on_terrain(opened, holed)).locate(View(picture, CAMERA, telemetry()))
    assert isinstance(fix, Fix) and fix.pose_cov is not None
    assert error_m(localizer, fix, PLACE) < 10


def test_simulated_level_ground_is_known_as_well_as_the_terrain(opened):
    localizer = on_terrain(opened, hills(0.05))
    known = localizer.registration.ground
    assert known.flattened().flat_errors.fields == (ERRORS.surface_m,)
    known.info = replace(ROUGH, roughness_m=None, source_posting_m=30.0)
    known.surface = None
    flattened, unknown = known.flattened(), Localizer(opened).registration.ground
    assert flattened.is_flat and flattened.flat_errors.slope == 0 < unknown.flat_errors.slope
    (std_m, _), _ = flattened.flat_errors.fields
    assert 3.0 < std_m <= 5.5  # 100 m times the slope
    assert unknown.flattened() is unknown


def test_level_ground_is_as_without_a_terrain(opened):
    """Views of a map whose terrain is level are placed as on a map without one; there the picture
    says less of pitch and roll."""
    picture = rendered(GROUND, PLACE, ATTITUDE)
    view = View(picture, CAMERA, telemetry((72.0, *ATTITUDE[1:]), AGL_M * 1.03, tilt_std_deg=0.0))
    fix, level = (each.locate(view) for each in (on_terrain(opened, hills(0.0)), Localizer(opened)))
    assert fix.lat_deg == pytest.approx(level.lat_deg, abs=5e-7)
    assert fix.confidence == pytest.approx(level.confidence, abs=1e-3)
    fix, level = (
        each.locate(replace(view, telemetry=replace(view.telemetry, tilt_std_deg=None)))
        for each in (on_terrain(opened, hills(0.0)), Localizer(opened))
    )
    assert level.pose_cov[4, 4] > 10 * fix.pose_cov[4, 4]


@pytest.mark.parametrize("attitude", [ATTITUDE, (10.0, -25.0, 15.0), (0.0, 85.0, 0.0)])
def test_formulas_for_level_ground_agree_with_those_for_any(opened, attitude):
    registration = Localizer(opened).registration
    picture = rendered(GROUND, PLACE, ATTITUDE)
    prepared = prepared_view(registration, View(picture, CAMERA, telemetry(ATTITUDE)), True)
    flat = GroundModel(
        Heights(Raster(np.zeros((70, 70), np.float32), -7e4, 7e4, 2e3)), registration.grid
    )
    grounds = registration.ground, flat
    seen, any_seen = (ViewOverGround(g, prepared, registration.reference) for g in grounds)
    assert seen.ground.is_flat and not flat.is_flat
    pose = Pose(300.0, 290.0, 0.3, 0.01)
    assert seen.reference_m(pose) == any_seen.reference_m(pose) == 0.0
    for above_m in (AGL_M, 0.0, -5.0):
        orientation = Orientation(np.array([*PLACE, above_m]), np.array(attitude))
        met, any_met = seen.sight_en_m(orientation), any_seen.sight_en_m(orientation)
        np.testing.assert_allclose(met, any_met, atol=1e-6)
    ground = np.zeros((3, 3))
    np.testing.assert_array_equal(seen.ground.slopes(ground), flat.slopes(ground))


def test_views_far_off_nadir_are_found_on_hills(opened, grey, relief):
    attitude = (70.0, 60.0, 0.0)
    place = np.array([-60.0, -120.0])
    picture, _ = seen_from(grey, relief, attitude, place=place)
    localizer = on_terrain(opened, relief)
    fix = localizer.locate(View(picture, CAMERA, telemetry((74.0, 60.0, 0.0))))
    assert error_m(localizer, fix, place) < 5.0 and fix.confidence > 0.9
