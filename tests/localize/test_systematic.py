"""Errors that displace blocks of a view together."""

import math
from dataclasses import replace

import numpy as np
import pytest
from blots import ROUGH

from orthonav.core.geo.camera import Camera, enu_from_camera
from orthonav.core.localize.camera import ground_by_picture, picture_by_camera, picture_by_ground
from orthonav.core.localize.resection import (
    ERRORS,
    GroundErrors,
    field_modes,
    lens_px,
    surface_errors,
    systematic,
    terrain_errors,
    unknown_ground,
)
from orthonav.core.localize.view import Orientation

CAMERA = Camera(400, 300, 400.0, 400.0, 200.0, 150.0)
AGL_M, BLOCK_M = 200.0, 30.0
SLOPES = np.full((36, 2), 0.03)


def places():
    at = (np.arange(6) - 2.5) * BLOCK_M
    return np.stack(np.meshgrid(at, at[::-1]), axis=-1).reshape(-1, 2)


def displaced(errors, camera=CAMERA):
    """Displacements by camera (36, 2, 6) and by systematic errors (36, 2, K), metres on level
    ground."""
    ground = np.concatenate([places(), np.zeros((36, 1))], axis=1)
    orientation = Orientation(np.array([0.0, 0.0, AGL_M]), np.zeros(3))
    by_ground = picture_by_ground(camera, orientation, ground)
    by_picture = ground_by_picture(by_ground, np.zeros((36, 2)))
    by_camera = -by_picture @ picture_by_camera(camera, orientation, ground, by_ground)
    by_lens = by_picture @ lens_px(camera, orientation.seen_px(camera, ground))
    found = systematic(
        errors,
        places_m=ground[:, :2],
        by_height_px=-by_camera[:, :, 2],
        by_lens_px=by_lens if camera.focal_std > 0 else None,
        block_px=BLOCK_M,
        gsd_m=1.0,
    )
    return by_camera, found


def explained(moves, by_camera):
    """Share of displacements (36, 2) that some camera explains."""
    design, values = by_camera.reshape(72, 6), moves.reshape(72)
    found, *_ = np.linalg.lstsq(design, values, rcond=None)
    return 1 - float(np.sum((values - design @ found) ** 2) / np.sum(values**2))


def test_a_slope_of_the_ground_displaces_as_a_tilt_of_the_camera():
    by_camera, found = displaced(GroundErrors(math.tan(math.radians(1.0)), (ERRORS.objects_m,)))
    for axis in range(2):
        assert explained(found.moves_px[:, :, axis], by_camera) > 0.999
    # By the same angle: both displace the corners alike, but for a shift and a scale.
    east = found.moves_px[:, :, 0].reshape(72)
    known = by_camera[:, :, [0, 1, 2, 3]].reshape(72, 4)
    roll = np.degrees(math.radians(1.0)) * by_camera[:, :, 5].reshape(72)
    (left, tilted) = (
        each - known @ np.linalg.lstsq(known, each, rcond=None)[0] for each in (east, roll)
    )
    assert np.linalg.norm(left) == pytest.approx(np.linalg.norm(tilted), rel=0.02)


def test_undulating_ground_displaces_as_no_camera_does():
    by_camera, found = displaced(GroundErrors(0.0, ((3.0, 20.0),)))
    ground = found.moves_px[:, :, found.components[0].at]
    shares = [explained(ground[:, :, k], by_camera) for k in range(ground.shape[2])]
    assert np.mean(shares) < 0.6


def test_a_nominal_lens_adds_errors_of_its_own():
    _, calibrated = displaced(GroundErrors(0.0, ((1.0, 50.0),)))
    _, nominal = displaced(GroundErrors(0.0, ((1.0, 50.0),)), replace(CAMERA, focal_std=0.05))
    more = nominal.moves_px[:, :, calibrated.moves_px.shape[2] :]
    assert more.shape == (36, 2, 4)
    # One percent of the width, and 5 % of the distance from the middle.
    np.testing.assert_allclose(np.abs(more[:, :, 0]), np.tile([2.0, 0.0], (36, 1)), atol=1e-6)
    np.testing.assert_allclose(np.hypot(*more[:, :, 2].T), 0.05 * np.hypot(*places().T), rtol=1e-3)


def test_fields_have_their_covariance_averaged_over_blocks():
    """Against the mean of a finely sampled field over each block."""
    std, length = 2.0, 25.0
    modes = field_modes(places(), (std, length), BLOCK_M)
    at = (np.arange(7) - 3) * BLOCK_M / 7
    fine = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    points = places()[[0, 1, 7, 35]][:, None] + fine
    squares = ((points[:, None, :, None] - points[None, :, None]) ** 2).sum(axis=-1)
    expected = std**2 * np.exp(-squares / (2 * length**2)).mean(axis=(2, 3))
    found = (modes @ modes.T)[np.ix_([0, 1, 7, 35], [0, 1, 7, 35])]
    np.testing.assert_allclose(found, expected, atol=0.05 * std**2)


def test_a_field_longer_than_the_view_keeps_its_slope():
    std, length = 6.0, 150.0
    near = places() / 4  # a view 45 m wide
    modes = field_modes(near, (std, length), BLOCK_M / 4)
    plane, *_ = np.linalg.lstsq(np.column_stack([near, np.ones(36)]), modes, rcond=None)
    np.testing.assert_allclose(np.hypot.reduce(plane[:2], axis=1), std / length, rtol=0.15)


def test_terrain_houses_and_dates_have_variances_of_their_own():
    _, found = displaced(GroundErrors(0.0, ((6.0, 150.0), ERRORS.objects_m)))
    terrain, objects, stretch = (each.at for each in found.components)
    assert (terrain.start, terrain.stop, objects.stop) == (0, objects.start, stretch.start)
    assert stretch.stop == found.moves_px.shape[2]


@pytest.mark.parametrize("relief, slope", [("level", 0.01), (None, 0.05), ("hills", 0.12)])
def test_unknown_ground_is_as_steep_as_the_map_says(relief, slope):
    errors = unknown_ground(relief)
    assert errors.slope == pytest.approx(slope / math.sqrt(2)) and ERRORS.objects_m in errors.fields


def test_errors_of_terrain_follow_its_source():
    bare = replace(ROUGH, roughness_m=0.3, source_posting_m=1.0)
    coarse = replace(bare, source_posting_m=30.0)
    rough = (ROUGH.roughness_m, ERRORS.objects_m[1])
    assert terrain_errors(ROUGH, SLOPES).fields == (ERRORS.surface_m, rough)
    assert terrain_errors(bare, SLOPES).fields == (ERRORS.bare_earth_m, ERRORS.objects_m)
    (std_m, length_m), objects = terrain_errors(coarse, SLOPES).fields
    assert 2.0 < std_m < ERRORS.coarse_std_m and length_m == 150.0 and objects == ERRORS.objects_m
    assert terrain_errors(coarse, 0 * SLOPES).fields[0][0] == ERRORS.bare_earth_m[0]
    assert terrain_errors(coarse, 10 * SLOPES).fields[0][0] == ERRORS.coarse_std_m
    assert terrain_errors(None, SLOPES) == terrain_errors(coarse, SLOPES)
    older = replace(bare, source_posting_m=None, roughness_m=None, posting_m=10.0)
    assert terrain_errors(older, 10 * SLOPES).fields[0][0] == pytest.approx(ERRORS.coarse_std_m / 3)
    half = np.where(np.arange(36)[:, None] < 18, np.nan, SLOPES)
    assert terrain_errors(coarse, half).fields == terrain_errors(coarse, SLOPES).fields
    assert terrain_errors(coarse, np.full((36, 2), np.nan)).fields[0][0] == ERRORS.coarse_std_m


def test_houses_that_lean_are_displaced_on_the_map():
    above = np.where(np.arange(36) % 3 == 0, 6.0, np.nan)
    upright, leaning = surface_errors(0.0, above), surface_errors(0.1, above)
    assert upright.fields == leaning.fields == (ERRORS.surface_m,) and upright.shift is None
    assert leaning.shift == pytest.approx((0.6, ERRORS.surface_m[1]))
    _, found = displaced(leaning)
    more = found.moves_px[:, :, found.components[-1].at]
    both = np.einsum("nak,nbk->ab", more, more) / len(more)
    wide = displaced(GroundErrors(0.0, (leaning.shift,)))[1]
    alone = wide.moves_px[:, :, wide.components[0].at]
    assert both[0, 0] == pytest.approx(both[1, 1]) and abs(both[0, 1]) < 1e-9 < both[0, 0]
    assert alone.shape[2] * 2 == more.shape[2]


@pytest.mark.parametrize("posting_m", [90.0, 250.0])
def test_a_coarser_terrain_is_not_believed_more(posting_m):
    """The slope of its error stays, and it leaves out undulation."""
    info = replace(ROUGH, roughness_m=None, source_posting_m=30.0)
    (fine_m, fine_length_m), _ = terrain_errors(info, 10 * SLOPES).fields
    coarse = replace(info, source_posting_m=posting_m)
    (std_m, length_m), undulation, _ = terrain_errors(coarse, 10 * SLOPES).fields
    assert std_m / length_m == pytest.approx(fine_m / fine_length_m) and std_m > fine_m
    assert undulation[1] == ERRORS.undulation_m[1] and 0 < undulation[0] <= std_m


def test_derivatives_of_points_on_a_slope_are_those_of_lines_of_sight():
    """Against the meeting of moved lines of sight with the slope."""
    orientation = Orientation(np.array([3.0, -5.0, 150.0]), np.array([40.0, 20.0, -8.0]))
    slope = np.array([0.1, -0.2])
    pixel = np.array([120.0, 220.0])

    def met(moved):
        ray = np.array([(pixel[0] - 200) / 400, (pixel[1] - 150) / 400, 1.0])
        ray = enu_from_camera(*moved.attitude_deg.tolist()) @ ray
        east, north, up = moved.position_m
        run = (up - slope @ [east, north]) / (slope @ ray[:2] - ray[2])
        return np.array([east, north]) + run * ray[:2]

    ground = np.array([[*met(orientation), float(slope @ met(orientation))]])
    by_ground = picture_by_ground(CAMERA, orientation, ground)
    by_camera = picture_by_camera(CAMERA, orientation, ground, by_ground)
    found = -(ground_by_picture(by_ground, slope[None]) @ by_camera)[0]
    for axis, step in enumerate(np.diag([0.01] * 6)):
        expected = (met(orientation.moved(step)) - met(orientation.moved(-step))) / 0.02
        np.testing.assert_allclose(found[:, axis], expected, rtol=1e-3, atol=1e-4)
