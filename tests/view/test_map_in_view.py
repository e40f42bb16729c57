"""The map as a camera sees it, against rays that meet a house or level ground by formula."""

import math
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
from blots import CAMERA, GROUND, rays, rendered
from scipy.spatial.transform import Rotation
from small_run import AGL_M, NO_FIX, WRONG, result, write_small_map

from orthonav.core.flight.fixes import write_results
from orthonav.core.mapfile import open_map
from orthonav.core.records import Telemetry
from orthonav.ground.report.imagery import SheetImagery
from orthonav.ground.view.perspective import map_in_view
from orthonav.ground.view.run import Run, ViewRequest
from orthonav.ground.view.server import Pages

LENS = replace(CAMERA, distortion=(-0.1, 0.02, 0.001, -0.001))
ROOF, ROOF_M, BASE_M = 250.0, 12.0, 130.0
SOUTH_WEST, NORTH_EAST = np.array([-12.0, 0.0]), np.array([10.0, 18.0])
"""Corners of the house."""
PLACE = np.array([-5.0, -62.0])


def in_house(east_m, north_m):
    (west, south), (east, north) = SOUTH_WEST, NORTH_EAST
    return (east_m > west) & (east_m < east) & (north_m > south) & (north_m < north)


def painted(east_m, north_m):
    """The ground, dark, with a bright roof."""
    ground = np.clip(GROUND(east_m, north_m), 0, 255) * 0.7
    return np.where(in_house(east_m, north_m), ROOF, ground)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A map with the house; its terrain has a hole in the north-west."""
    cols, rows = np.meshgrid(np.arange(350) + 0.5, np.arange(310) + 0.5)
    terrain = np.full(cols.shape, BASE_M, np.float32)
    terrain[:40, :80] = np.nan
    surface = np.where(in_house(cols - 180, 160 - rows), ROOF_M, 0).astype(np.float32)
    path = tmp_path_factory.mktemp("town") / "town.onav"
    write_small_map(path, ground=painted, heights=(terrain, surface))
    return SheetImagery(open_map(path))


def telemetry(attitude, agl_m=AGL_M):
    return Telemetry(0, *attitude, agl_m)


def on_plane(camera, attitude, above_m):
    """Where rays meet a level plane (H, W) east and north; NaN at the sky."""
    ned = Rotation.from_euler("ZYX", attitude, degrees=True).apply(rays(camera))
    down = np.where(ned[:, 2] > 0, ned[:, 2], np.nan)
    shape = camera.height_px, camera.width_px
    return [PLACE[i] + (ned[:, 1 - i] / down * above_m).reshape(shape) for i in (0, 1)]


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("attitude", [(0.0, 42.0, 0.0), (20.0, 38.0, -9.0)], ids=str)
def test_a_roof_is_where_it_is_seen_and_hides_the_ground_behind(town, camera, attitude):
    grey, valid = map_in_view(town, camera, telemetry(attitude), PLACE)
    ground = on_plane(camera, attitude, AGL_M)
    roof = in_house(*on_plane(camera, attitude, AGL_M - ROOF_M))
    levels = np.linspace(0.0, ROOF_M, 60)
    house = np.any([in_house(*on_plane(camera, attitude, AGL_M - up)) for up in levels], axis=0)
    roof, free = eroded(roof), eroded(~house)
    assert valid.all() and free.mean() > 0.6
    assert (roof & ~in_house(*ground)).sum() > 500  # hides the ground behind
    assert (grey[roof] > ROOF - 8).all()
    assert np.abs(grey[free] - painted(*ground)[free]).mean() < 4


def eroded(mask):
    """By what a surface every metre and interpolation displace an edge by, in pixels."""
    return cv2.erode(mask.astype(np.uint8), np.ones((9, 9)), borderValue=1) > 0


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_level_ground_without_terrain(small, camera):
    sheet = SheetImagery(open_map(small.map_path))
    for attitude in ((40.0, 4.0, -3.0), (-100.0, 50.0, 12.0)):
        grey, valid = map_in_view(sheet, camera, telemetry(attitude), PLACE)
        expected = rendered(GROUND, PLACE, attitude, AGL_M, camera)
        assert valid.mean() > 0.7
        assert np.corrcoef(grey[valid], expected[valid])[0, 1] > 0.95
        assert (grey[~valid] == 0).all()


def test_the_sky_and_what_the_map_does_not_know_are_blank(town):
    attitude = (-45.0, 75.0, 5.0)
    _, valid = map_in_view(town, CAMERA, telemetry(attitude), PLACE)
    east, north = on_plane(CAMERA, attitude, AGL_M)
    inside = (np.abs(east + 5) < 175) & (np.abs(north - 5) < 155)
    unknown = (east < -100) & (north > 120)
    assert (valid & ~inside).sum() < 400 and np.isnan(east).mean() > 0.1
    assert unknown.any() and (valid & unknown).mean() < 0.005
    assert (inside & ~unknown & ~valid).mean() < 0.02
    for place in (PLACE + 5000, np.array([-150.0, 140.0])):  # far outside; over the hole
        _, valid = map_in_view(town, CAMERA, telemetry((0.0, 0.0, 0.0), 20.0), place)
        assert not valid.any()


def served(small, tmp_path, results, map_path=None):
    write_results(tmp_path / "new.jsonl", results)
    return Run(ViewRequest(tmp_path / "new.jsonl", map_path or small.map_path, flight=small.flight))


def fetched(run, name):
    reply = Pages(run, {}).answer(f"/api/views/0/{name}")
    assert reply.status == 200 and reply.media_type.startswith("image/")
    picture = cv2.imdecode(np.frombuffer(reply.data, np.uint8), cv2.IMREAD_UNCHANGED)
    return picture if picture.ndim == 2 else picture[..., 0]


@pytest.mark.parametrize("layer", [True, False], ids=["layer", "preview"])
def test_a_fix_is_seen_to_be_right_or_wrong(small, tmp_path, layer):
    path = write_small_map(tmp_path / "area.onav", layer=layer)
    for i in (0, WRONG):
        run = served(small, tmp_path, [result(i)], path)
        seen, raw = fetched(run, "map-in-view.png"), fetched(run, "raw.jpg")
        assert seen.shape == raw.shape
        alike = np.corrcoef(seen.ravel(), raw.ravel())[0, 1]
        assert alike < 0.4 if i == WRONG else alike > 0.95 - 0.1 * (not layer)


def test_attitude_and_place_that_are_unknown(small, tmp_path, monkeypatch):
    """A fix without attitude has the reported one."""
    plain = result(0)
    fix = replace(plain.outcome, heading_deg=math.nan, pitch_deg=math.nan)
    run = served(small, tmp_path, [replace(plain, outcome=fix)])
    expected = fetched(served(small, tmp_path, [plain]), "map-in-view.png")
    assert (fetched(run, "map-in-view.png") == expected).all()
    shot = run._images.shot(plain.frame)
    unknown = replace(shot, telemetry=replace(shot.telemetry, pitch_deg=math.nan))
    monkeypatch.setattr(run._images, "shot", lambda frame: unknown)
    reply = Pages(run, {}).answer("/api/views/0/map-in-view.png")
    assert reply.status == 404 and b"pitch_deg" in reply.data
    none = Pages(served(small, tmp_path, [result(NO_FIX)]), {})
    reply = none.answer("/api/views/0/map-in-view.png")
    assert reply.status == 404 and b"has no fix" in reply.data


def test_a_map_that_was_removed_or_cut(small, tmp_path):
    path = write_small_map(tmp_path / "area.onav")
    run = served(small, tmp_path, [result(0)], path)
    moved = path.rename(tmp_path / "moved.onav")
    fetched(run, "map-in-view.png")  # the file stays open
    run = served(small, tmp_path, [result(0)], moved)
    os.truncate(moved, 100)
    reply = Pages(run, {}).answer("/api/views/0/map-in-view.png")
    assert reply.status == 500 and b"map file changed" in reply.data
