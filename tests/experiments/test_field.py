"""The field today: features are matched under the reported pose and prior, and counted fairly."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest
from experiments.paper import field, matchers, runs, scenes
from experiments.paper.field import Placed
from experiments.paper.matchers import FeatureMap, Sift
from experiments.paper.methods import REDUCED, TABLE_1, Method
from experiments.paper.posed import Picture
from experiments.paper.results import Result, compact

from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import Telemetry, View

CAMERA = Camera(256, 256, 500.0, 500.0, 128.0, 128.0)
REPORTED = Telemetry(0, 0.0, 0.0, 0.0, 500.0, yaw_std_deg=5.0, agl_std_m=15.0)
SMALL = replace(TABLE_1["B"], name="B", length_m=320.0, band_m=288.0)


@pytest.fixture(scope="module")
def picture():
    """A map of 1000 x 700 px at 1 m, blurred noise."""
    grid = TileGrid.covering((0.0, -700.0, 1000.0, 0.0), gsd_m=1.0, tile_px=256, overlap=0.875)
    noise = np.random.default_rng(1).normal(size=(grid.height_px, grid.width_px))
    smooth = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), 2.5)
    grey = np.clip(128 + 50 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    return Picture(grid, 1, grey, np.ones(grey.shape, bool))


@pytest.fixture(scope="module")
def sift(picture):
    return FeatureMap(Sift(), picture)


def seen(picture, place_px, turn_deg=0.0, scale=1.0):
    """A view around a place (x, y), turned and magnified, and where that is in the sheet."""
    matrix = cv2.getRotationMatrix2D(place_px, turn_deg, scale)
    matrix[:, 2] += 128 - np.array(place_px)
    grey = cv2.warpAffine(picture.grey, matrix, (256, 256))
    return View(grey, CAMERA, REPORTED), picture.place_en_m(*place_px)


@pytest.mark.parametrize("place_px", [(300, 250), (640, 320), (700, 420)])
def test_a_view_of_the_same_date_is_found_within_a_pixel(picture, sift, place_px):
    """Also across the blocks in which the map's keypoints are found."""
    view, truth = seen(picture, place_px)
    found = sift.locate(view, np.add(truth, [40, -30]), 40.0)
    assert np.hypot(*(found.place_en_m - truth)) < 1 and found.evidence > 50


def test_a_mirrored_view_is_not_found(picture, sift):
    view, truth = seen(picture, (400, 300))
    mirrored = replace(view, grey=np.ascontiguousarray(view.grey[:, ::-1]))
    assert sift.locate(mirrored, truth, 40.0) is None


@pytest.mark.parametrize("turn_deg, scale, fits", [(10, 1, True), (20, 1, False), (0, 1.2, False)])
def test_what_contradicts_the_reported_pose_is_refused(picture, sift, turn_deg, scale, fits):
    view, truth = seen(picture, (400, 300), turn_deg, scale)
    assert (sift.locate(view, truth, 40.0) is not None) == fits
    blind = replace(view, telemetry=replace(REPORTED, yaw_std_deg=None, agl_std_m=None))
    assert sift.locate(blind, truth, 40.0) is not None


def test_nothing_is_looked_for_beyond_the_prior(picture, sift):
    view, truth = seen(picture, (300, 300))
    assert sift.locate(view, np.add(truth, [500, 0]), 40.0) is None
    assert sift.locate(view, np.add(truth, [500, 0]), 400.0) is not None


@pytest.mark.parametrize("name", [each for each in matchers.LOCAL if "SIFT" not in each])
def test_local_features_of_today_find_a_view_of_the_same_date(picture, name):
    grid = TileGrid.covering((0.0, -400.0, 400.0, 0.0), gsd_m=1.0, tile_px=256, overlap=0.875)
    part = np.ascontiguousarray(picture.grey[: grid.height_px, : grid.width_px])
    small = Picture(grid, 1, part, np.ones(part.shape, bool))
    view, truth = seen(small, (200, 210))
    matchers.one_thread()
    found = FeatureMap(matchers.LOCAL[name](), small).locate(view, np.add(truth, [20, 10]), 40.0)
    assert np.hypot(*(found.place_en_m - truth)) < 1.5 and found.evidence >= 20


def result(scene, errors, evidence, mirrored, gsd_m=1.0, key="SIFT, ratio test"):
    views = [[error, each] for error, each in zip(errors, evidence, strict=True)]
    part = {"views": views, "mirrored": mirrored, "prior_m": [20.0] * len(views)}
    part |= dict.fromkeys(("cpu_s", "prepare_cpu_s", "peak_mb", "carried_mb"), 1.0)
    flown = asdict(replace(SMALL, gsd_m=gsd_m))
    made = {"scene": scene, "trajectory": flown, "field": {key: part}, "methods": []}
    made["errors"] = {"yaw_std_deg": 5.0, "agl_std": 0.03, "prior_std_px": 40.0}
    made |= {"provenance": {"commit": "0", "dirty": False, "date": "", "cpu": ""}, "minutes": 1.0}
    return Result(json.loads(compact(made)))


def test_what_could_be_trusted_is_counted_against_wrong_and_mirrored_views():
    errors, evidence = [1.0, 20.0, 50.0, None], [9, 7, 6, None]
    placed = Placed.of([result("B", errors, evidence, [None, 8])], "SIFT, ratio test")
    assert placed.within() == 0.25 and placed.right.tolist() == [True, True, False, False]
    assert placed.trusted() == 0.5  # 9 is above the mirrored 8, 7 is not
    assert placed.accepted(7.0) == (1.0, 1) and placed.accepted(5.0) == (1.0, 2)
    assert placed.median_m() == 10.5
    coarse = Placed.of([result("naip", errors, evidence, [None], gsd_m=5.0)], "SIFT, ratio test")
    assert coarse.right.tolist() == [True, True, True, False]  # 10 px are 50 m
    assert coarse.trusted() == 1.0
    none = Placed.of([result("B", [None], [None], [None])], "SIFT, ratio test")
    assert np.isnan(none.trusted()) and np.isnan(none.median_m()) and none.within() == 0


def test_one_threshold_holds_for_all_scenes():
    rows = [
        result("B", [1.0, 1.0], [5, 9], [None, None]),
        result("tours", [1.0, 90.0], [12, 7], [None, 3]),
    ]
    assert Placed.of(rows, "SIFT, ratio test").trusted() == pytest.approx(2 / 3)
    assert Placed.of(rows[:1], "SIFT, ratio test").trusted() == 1


@pytest.fixture(scope="module")
def placed(tmp_path_factory, area):
    """The field on a small scene, with SIFT and the map of the embedding alone."""
    setting = replace(REDUCED, views=3, swept=1)
    place = runs.Workplace(tmp_path_factory.mktemp("field"), setting, "test")
    scene = scenes.Scene("B", area.past, area.present, SMALL)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthonav.ground.build.calibrate.CROPS", 8)
        runs.run(place, scene, Method("gradient", "gradient", "gradient"))
        names = {"SIFT, ratio test": Sift}
        patch.setattr(matchers, "LOCAL", names)
        patch.setattr(matchers, "one_thread", lambda: None)
        patch.setattr(field, "ProcessPoolExecutor", lambda *_, **__: ThreadPoolExecutor(1))
        assert field.run(place, scene) and not field.run(place, scene)
    return place, scene


@pytest.mark.slow  # an experiment
def test_every_method_gets_the_same_views(placed):
    place, scene = placed
    made = json.loads(place.result(scene, "field").read_text())
    assert list(made["field"]) == ["SIFT, ratio test", "gradient-gradient"]
    assert [each["family"] for each in made["methods"]] == ["gradient"]
    priors = [part["prior_m"] for part in made["field"].values()]
    assert priors[0] == priors[1] and max(priors[0]) <= 40 * 2.5 * np.sqrt(2)
    for part in made["field"].values():
        assert len(part["views"]) == len(part["mirrored"]) == len(priors[0])
        assert part["peak_mb"] > 10 and part["cpu_s"] > 0 and part["carried_mb"] > 0
    localizer = Localizer(open_map(place.work(scene, "gradient-gradient") / "map.onav"))
    first, again = (list(field.seen(scene, localizer, 3)) for _ in range(2))
    assert all(np.array_equal(a.grey, b.grey) for a, b in zip(first, again, strict=True))
