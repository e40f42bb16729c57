"""Views in perspective: level ground as by its homography, objects displaced as they stand."""

import math

import cv2
import numpy as np
import pytest
from lab.landscape import generate_area, generate_heights
from lab.landscape.epoch import DEFAULT_DATES
from lab.terrain import seen_view
from simulated import FISH, LENS, PLAIN, SEEN, WIDE

from orthonav.core.geo.camera import Camera, enu_from_camera, seen_px
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.simulate.render import Raster, met, rays_enu, render_view

CAMERA = Camera(160, 120, 130.0, 130.0, 80.0, 60.0)
AUTUMN = DEFAULT_DATES[1]


@pytest.fixture(scope="module")
def imagery():
    noise = np.random.default_rng(1).normal(0, 1, (500, 500, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return Raster(np.clip(128 + 900 * smooth, 0, 255).astype(np.uint8), -250.0, 250.0, 1.0)


@pytest.mark.parametrize("camera", [SEEN, LENS, FISH], ids=["pinhole", "lens", "fisheye"])
def test_level_ground_is_seen_as_by_its_homography(imagery, camera):
    attitude, agl_m = (40.0, 12.0, -7.0), 150.0
    level = Raster(np.full((2, 2), 30, np.float32), -250.0, 250.0, 250.0)
    place = np.array([10.0, -20.0, 30.0 + agl_m])
    seen, _ = seen_view(imagery, level, camera, attitude, place, 1)
    corner = np.array([-250.0, 250.0]) - place[:2]
    rng = np.random.default_rng(1)
    flat = render_view(camera, (*attitude, agl_m), imagery.values, corner, 1.0, PLAIN, rng)
    assert np.abs(seen.astype(float) - flat).mean() < 1.0


@pytest.mark.parametrize("camera", [SEEN, LENS, WIDE, FISH])
def test_rays_are_those_of_the_lens(camera):
    attitude = 40.0, 12.0, -7.0
    rays = rays_enu(camera, attitude, 1) @ enu_from_camera(*attitude)
    middles = np.stack(np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5), axis=-1)
    assert np.abs(seen_px(camera, rays) - middles).max() < 0.001


def test_a_roof_stands_out_and_hides_the_ground_behind():
    heights = np.zeros((400, 400), np.float32)
    heights[170:180, 190:210] = 20.0  # 20 m to 30 m north of the camera
    ground = Raster(heights, -200.0, 200.0, 1.0)
    rays = rays_enu(CAMERA, (0.0, 0.0, 0.0), 1)
    points = met(ground, rays, np.array([0.0, 0.0, 100.0]))
    north, up = points[:, 80, 1], points[:, 80, 2]
    roof = up > 19.0
    assert north[roof].min() == pytest.approx(20.0, abs=1.5)
    assert north[roof].max() == pytest.approx(30.0, abs=1.5)
    # Its far edge hides the ground up to 30 * 100 / 80.
    beyond = north[(up < 1.0) & (north > 30.5)]
    assert beyond.min() == pytest.approx(37.5, abs=1.2)


@pytest.mark.long
def test_a_flight_with_a_leaning_camera_over_a_surface_model(tmp_path, fly):
    size = {"size_m": (340.0, 320.0), "dates": (AUTUMN,), "seed": 2}
    (ortho,) = generate_area(tmp_path, **size)
    dem, dsm = (open_dem(p, None) for p in generate_heights(tmp_path, slope=0.1, **size))
    request = {"random": 2, "agl_m": 50.0, "camera": CAMERA, "camera_pitch_deg": 60.0, "seed": 5}
    pictures = {}
    for name, terrain in (("dem", dem), ("dsm", dsm)):
        over = {"over": ortho, "terrain": terrain, "terrain_posting_m": terrain.gsd_m}
        flight, truth, _ = fly(**over, **request)
        telemetry = flight.views[0].telemetry
        assert telemetry.pitch_deg == 60.0 and math.isnan(telemetry.agl_m)
        below = float(terrain(*np.array([[each] for each in truth[flight.views[0].frame]]))[0])
        assert telemetry.amsl_m == pytest.approx(below + 50.0, abs=0.1)
        pictures[name] = np.stack([view.grey() for view in flight.views]).astype(float)
    assert (np.abs(pictures["dem"] - pictures["dsm"]) > 15).mean() > 0.005
