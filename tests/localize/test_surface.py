"""Views over houses on a map that knows them, against rays that are followed to the roofs."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from blots import AGL_M, CAMERA, GROUND, Heights, as_grey, error_m
from lab.terrain import seen_view

from orthonav.core.localize import Localizer
from orthonav.core.localize.camera import approached, camera_of
from orthonav.core.localize.ground import SAMPLING, GroundModel, ViewOverGround, _smoothed
from orthonav.core.localize.prepared import PreparedMap
from orthonav.core.localize.resection import ERRORS
from orthonav.core.localize.search import prepared_view
from orthonav.core.localize.view import hidden
from orthonav.core.mapfile.manifest import Lean, TerrainInfo
from orthonav.core.records import Telemetry, View
from orthonav.core.register.window import Pose
from orthonav.ground.build.lean import as_shown
from orthonav.ground.simulate.render import Raster

SIDE_M, FINEST_M, BASE_M = 700.0, 0.5, 100.0
AT_M = np.arange(FINEST_M / 2, SIDE_M, FINEST_M) - SIDE_M / 2
ATTITUDE = (70.0, 30.0, 0.0)
PLACE = np.array([30.0, -90.0])


def placed(localizer, view, place=PLACE, heading_deg=ATTITUDE[0], scale=1.0):
    """A view over the ground of the map, and its pose under a camera at a place."""
    registration = localizer.registration
    over_ground = ViewOverGround(
        registration.ground, prepared_view(registration, view, True), registration.reference
    )
    x, y = registration.ground.map_px(place)
    pose = Pose(0.0, 0.0, np.radians(heading_deg), np.log(scale))
    moved_x, moved_y = pose.map_px(over_ground.view.camera_px).tolist()
    return over_ground, replace(pose, x_px=x - moved_x, y_px=y - moved_y)


def raster(values):
    return Raster(values.astype(np.float32), -SIDE_M / 2, SIDE_M / 2, FINEST_M)


@pytest.fixture(scope="module")
def town():
    """Ground of 2 % and houses of 12 m above it, up to 10 m high."""
    east, north = np.meshgrid(AT_M, -AT_M)
    number = np.floor(east / 30.0) * 17 + np.floor(north / 30.0) * 5
    houses = (np.mod(east, 30.0) < 12.0) & (np.mod(north, 30.0) < 12.0)
    above = houses * (4.0 + np.mod(number, 7.0))
    grey = as_grey(GROUND(east, north)).astype(np.float32)
    return raster(grey), raster(BASE_M + 0.02 * east), raster(above)


def on(opened, ground, surface, lean=None):
    localizer = Localizer(opened)
    localizer.registration.ground = GroundModel(
        Heights(ground), localizer.grid, None, None, surface, lean
    )
    return localizer


def shown(above, lean):
    """Heights of houses where a map with this lean shows them."""

    def high(west_m, north_m, posting_m, rows, cols):
        at = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
        return above.at(west_m + at[0] * posting_m, north_m - at[1] * posting_m)

    side = len(above.values)
    return raster(as_shown(high, lean)(-SIDE_M / 2, SIDE_M / 2, FINEST_M, side, side))


def seen_by_camera(grey, ground, above):
    solid = Raster(ground.values + above.values, ground.west_m, ground.north_m, FINEST_M)
    below = float(ground.at(PLACE[:1], PLACE[1:])[0])
    position = np.array([*PLACE, below + AGL_M / 2])
    picture, _ = seen_view(grey, solid, CAMERA, ATTITUDE, position, finer=1)
    return View(picture, CAMERA, Telemetry(0, 72.0, 31.0, -1.0, 1.04 * AGL_M / 2))


@pytest.fixture(scope="module")
def view(town):
    return seen_by_camera(*town)


def test_the_camera_is_found_among_houses_to_decimetres(opened, town, view):
    _, ground, above = town
    known = (localizer := on(opened, ground, Heights(above))).locate(view)
    unknown = (bare := on(opened, ground, None)).locate(view)
    error = error_m(localizer, known, PLACE)
    assert error < 0.4 and known.confidence > 0.9
    assert error < 0.5 * error_m(bare, unknown, PLACE)
    assert np.trace(known.cov_en_m2) < 0.5 * np.trace(unknown.cov_en_m2)
    assert error**2 < 9.0 * np.trace(known.cov_en_m2)


def test_the_camera_is_approached_from_metres_and_degrees(opened, town, view):
    """Where only the finer level shows it."""
    _, ground, above = town
    off = PLACE + np.array([2.0, -1.5]), ATTITUDE[0] + 1.0, 0.98
    over_ground, pose = placed(on(opened, ground, Heights(above)), view, *off)
    found, start = approached(over_ground, pose), over_ground.orientation(pose)
    below = float(ground.at(PLACE[:1], PLACE[1:])[0])
    truth = np.array([*PLACE, below + AGL_M / 2])
    assert np.linalg.norm(start.position_m - truth) > 2.0
    assert np.linalg.norm(found.position_m - truth) < 0.7
    assert np.abs(found.attitude_deg - ATTITUDE).max() < 0.4


def test_a_camera_that_the_picture_does_not_show_among_houses_is_not_found(opened, town, view):
    _, ground, above = town
    rng = np.random.default_rng(0)
    blots = cv2.GaussianBlur(rng.normal(0.0, 1.0, view.grey.shape), (0, 0), 3.0)
    other = np.clip(128 + 40 * blots / blots.std(), 0, 255).astype(np.uint8)
    for surface, shown in ((Heights(above), False), (None, True)):  # over bare ground not asked
        localizer = on(opened, ground, surface)
        for picture, found in ((view.grey, True), (other, shown)):
            camera = camera_of(*placed(localizer, replace(view, grey=picture)), 1.0, 0.0)
            assert (camera is not None) == found


@pytest.mark.parametrize("east, north", [(0.3, -0.2), (-0.25, 0.0)])
def test_houses_that_lean_on_the_map_are_seen_where_they_stand(opened, town, view, east, north):
    _, ground, above = town
    lean = Lean(east, north, 0.0)
    over_ground, pose = placed(on(opened, ground, Heights(shown(above, lean)), lean), view)
    nodes, on_map = over_ground._nodes_m(pose, 0, (120, 160), smooth=False)
    high_m = nodes[..., 2] - over_ground.ground.terrain.at_en_m(on_map[..., :2])
    off_m = on_map[..., :2] - nodes[..., :2] - high_m[..., None] * [east, north]
    assert np.nanmax(np.abs(off_m)) < 1e-6 and np.nanmax(high_m) > 5.0


def test_the_camera_is_found_on_a_map_whose_houses_lean(opened, town):
    """The map shows roofs beside their place; in the view they are where they stand."""
    grey, ground, above = town
    lean, high = Lean(0.3, -0.2, 0.0), above.values
    east, north = np.meshgrid(AT_M, -AT_M)
    roofs = raster(grey.at(east + lean.east * high, north + lean.north * high))
    view = seen_by_camera(roofs, ground, above)
    found = (localizer := on(opened, ground, Heights(shown(above, lean)), lean)).locate(view)
    upright = (plain := on(opened, ground, Heights(above))).locate(view)
    error = error_m(localizer, found, PLACE)  # 0.11 m; 0.21 m where the lean is not known
    assert error < 0.4 and found.confidence > 0.9
    assert error**2 < 9.0 * np.trace(found.cov_en_m2)
    assert error < 0.7 * error_m(plain, upright, PLACE)


def test_an_unknown_height_at_the_rim_hides_nothing_less(opened, town, view):
    _, ground, above = town
    holed = raster(np.where(np.arange(len(above.values))[:, None] < 940, above.values, np.nan))
    hides = []
    for surface in (above, holed):
        over_ground, pose = placed(on(opened, ground, Heights(surface)), view)
        nodes, _ = over_ground._nodes_m(pose, 0, (200, 260), smooth=False)
        assert np.isfinite(nodes[..., :2]).all()
        hides.append(hidden(nodes, over_ground.orientation(pose).position_m))
    known = np.isfinite(nodes[..., 2])
    assert hides[0][known].sum() > 50
    assert hides[1][known].sum() > 0.5 * hides[0][known].sum()  # not none


def test_a_leaning_house_hides_the_ground_behind_it():
    """As an upright one: on the map, with its camera, everything is sheared."""
    at, lean = np.arange(80.0), Lean(0.5, -0.25, 0.0)
    east, north = np.meshgrid(at, -at)
    high = np.where((abs(east - 40) < 8) & (abs(north + 40) < 8), 8.0, 0.0)

    def above(west_m, north_m, posting_m, rows, cols):
        rim = (rows - 80) // 2
        return np.pad(high, rim, constant_values=np.nan) if rim else high

    camera = np.array([10.0, -30.0, 25.0])
    upright = hidden(np.dstack([east, north, high]), camera)
    shown = as_shown(above, lean)(0.0, 0.0, 1.0, 80, 80)
    sheared = camera + camera[2] * np.array([lean.east, lean.north, 0.0])
    leaning = hidden(np.dstack([east, north, shown]), sheared)
    ground = (high == 0) & (shown == 0)
    assert upright[ground].sum() > 100
    assert (upright != leaning)[ground].mean() < 0.02


def test_a_hole_hides_no_more_than_itself(opened, town, view):
    """Smoothing leaves out what is unknown: a hole, and all beyond the map, next to the view."""
    _, ground, above = town
    east, north = np.meshgrid(AT_M, -AT_M)
    near = (np.abs(east - PLACE[0] - 20.0) < 4.0) & (np.abs(north - PLACE[1]) < 4.0)
    beyond = east < PLACE[0] - 40.0
    whole = on(opened, ground, Heights(above)).locate(view)
    for missing in (near, beyond):
        holed = raster(np.where(missing, np.nan, ground.values))
        fix = (localizer := on(opened, holed, Heights(above))).locate(view)
        assert error_m(localizer, fix, PLACE) < 0.5
        assert np.trace(fix.cov_en_m2) < 3.0 * np.trace(whole.cov_en_m2)


@pytest.mark.parametrize("side", [2, 5, 12])
def test_smoothing(side):
    rng = np.random.default_rng(0)
    heights = rng.normal(0.0, 1.0, (60, 80))
    heights[20:24, 30:34] = np.nan
    made = _smoothed(heights, side)
    np.testing.assert_array_equal(np.isnan(made), np.isnan(heights))
    half = side // 2
    for row, col in ((22, 36), (40, 40), (30, 60)):
        around = heights[row - half : row + half + 1, col - half : col + half + 1]
        assert made[row, col] == pytest.approx(np.nanmean(around))
    assert _smoothed(heights, 1) is heights


def test_scales_are_expected_by_place_where_the_view_looks_ahead(opened, town):
    """A valley 40 m deep east of the camera: the scale of views that look into it is larger."""
    grey, _, _ = town
    cliff = raster(np.broadcast_to(np.where(AT_M > 0, 60.0, 100.0), grey.values.shape))
    registration = on(opened, cliff, None).registration
    agl_m = AGL_M / 2

    def expected(heading_deg, ahead_deg, agl_std_m=None):
        telemetry = Telemetry(0, heading_deg, ahead_deg, 0.0, agl_m, agl_std_m=agl_std_m)
        picture = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
        prepared = prepared_view(registration, View(picture, CAMERA, telemetry), True)
        return registration.ground.expected(prepared), prepared

    nadir, prepared = expected(90.0, 0.0)
    assert nadir is prepared.prior
    found, prepared = expected(90.0, 45.0)
    values = found.scale_map.values
    # From the level ground beyond the cliff into the valley, and over either of the two alone.
    assert values.max() == pytest.approx(np.log1p(40.0 / agl_m), abs=0.1)
    assert np.abs(values[:, [0, -1]]).max() < 0.02
    away, _ = expected(270.0, 45.0)
    assert away.scale_map.values.min() < -0.15  # what lies above the ground below the camera
    stated, _ = expected(90.0, 45.0, 0.04 * agl_m)
    assert stated.scale_map.std == pytest.approx(0.04)


@pytest.mark.parametrize(("share", "finer"), [(0.45, False), (0.55, True)])
def test_views_are_compared_one_level_finer_where_houses_are_mostly_known(opened, share, finer):
    made = Localizer(opened).registration
    imagery_m2, posting_m = made.sheet.grey.valid_px * made.grid.gsd_m**2, 0.5
    known = round(share * imagery_m2 / posting_m**2)
    info = TerrainInfo(0.0, 0.0, posting_m, 9, 9, 16, 0.0, 9.0, 0.1, known, "surface", "none")
    surface = SimpleNamespace(info=info)
    found = PreparedMap(
        made.sheet, made.pyramid, confidence=None, radius_m=9.0, floor_px=1.0, surface=surface
    )
    assert found.is_finer == finer


def test_views_on_level_ground_know_the_surface_of_a_route(town, opened):
    """Most of the sheet is off the route: neither ground nor houses are known there."""
    _, ground, above = town
    grid = opened.manifest.sheets[0].grid
    from_m = grid.west_m + 0.7 * grid.width_px * grid.gsd_m
    parts = Heights(ground, from_m=from_m), Heights(above, from_m=from_m)
    relief = GroundModel(parts[0], grid, None, None, parts[1])
    assert relief.flattened().flat_errors.fields == (ERRORS.surface_m,)


def test_a_surface_counts_where_most_of_it_is_known(town, opened):
    _, ground, above = town
    grid = opened.manifest.sheets[0].grid
    px = np.stack(np.meshgrid(np.linspace(50, 250, 40), np.linspace(50, 250, 40)), -1)
    east_m = grid.west_m + np.linspace(50, 250, 40) * grid.gsd_m
    for share in (0.2, 0.8):
        surface = Heights(above, from_m=float(np.quantile(east_m, 1 - share)))
        relief = GroundModel(Heights(ground), grid, None, None, surface)
        found, level = relief.surface_m(px)[..., 2], relief.ground_m(px)[..., 2]
        errors = relief.errors(relief.ground_m(px).reshape(-1, 3), np.zeros((1600, 2)))
        if share < SAMPLING.min_known:
            np.testing.assert_array_equal(found, level)
            assert ERRORS.surface_m not in errors.fields
        else:
            assert np.isnan(found).mean() == pytest.approx(1 - share, abs=0.03)
            assert np.nanmax(found - level) > 3.0
            assert errors.fields == (ERRORS.surface_m,)
