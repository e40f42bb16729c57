"""The paper's experiments: geometry of trajectories, views, tables, resuming. No figure of it."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from experiments.paper import dates, runs, scenes, words
from experiments.paper.__main__ import main
from experiments.paper.methods import FULL, REDUCED, TABLE_1, Method, methods
from experiments.paper.results import accepted_at, confident
from experiments.paper.tables import report

from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize import Localizer
from orthonav.core.mapfile import open_map
from orthonav.core.records import View
from orthonav.ground.planning.area import Area

SMALL = replace(TABLE_1["B"], name="B", length_m=320.0, band_m=288.0)
CENTRES = np.stack(np.meshgrid(np.arange(0, 320, 32), np.arange(0, 160, 32)), -1)
CENTRES = CENTRES.reshape(-1, 2).astype(np.float32)


@pytest.mark.parametrize("name", TABLE_1)
def test_tiles_of_the_full_trajectories_are_those_of_the_grid(name):
    flown = FULL.trajectory(name)
    half = flown.length_m / 2, flown.band_m / 2
    grid = TileGrid.covering(
        (-half[0], -half[1], half[0], half[1]),
        gsd_m=flown.gsd_m,
        tile_px=256,
        overlap=flown.overlap,
    )
    assert grid.rows * grid.cols == flown.tiles
    assert grid.stride_m == pytest.approx(flown.stride_m)


def test_a_picture_is_like_itself_and_not_like_another():
    rng = np.random.default_rng(0)
    one, other = (cv2.resize(each, (256, 256)) for each in rng.integers(0, 256, (2, 32, 32), "u1"))
    assert dates.alike([(one, one)]) == pytest.approx({"grey": 1, "canny": 1, "features": 1})
    assert max(map(abs, dates.alike([(one, other)]).values())) < 0.2
    assert dates.correlation(one, np.zeros_like(one)) == 0
    assert dates.found_again(np.zeros_like(one), one) == 0


def test_bags_of_words_are_weighed_and_ranked():
    counts = np.array([[3, 1], [0, 4], [0, 0]])
    bags = words.weighed(counts, np.array([1.0, 2.0]), "product", 0)
    assert bags.tolist() == [[0.75, 0.25], [0, 1], [0, 0]]
    scaled = words.weighed(counts, np.array([1.0, 3.0]), "cosine", 1)
    assert scaled == pytest.approx(np.array([[1, 1], [0, 2**0.5], [0, 0]]) / 2**0.5)
    centres = np.array([[0.0, 0], [10, 0], [99, 0]])
    found = words.placed(np.array([[0.2, 0.5, 0.1], [0.3, 0.2, 0.9]]), [0, 1], centres)
    assert found == {"right": [1, 2], "above": pytest.approx(0.5)}


def test_views_snap_to_the_nearest_tile_centre():
    places = scenes.places_en_m(CENTRES, 50)
    snapped = scenes.on_grid(places, CENTRES)
    assert np.abs(snapped - places).max() <= 16
    assert {tuple(each) for each in snapped} <= {tuple(each) for each in CENTRES}
    assert np.abs(places / 32 - np.rint(places / 32)).max() > 0.1
    assert np.array_equal(places, scenes.places_en_m(CENTRES, 50))
    assert (np.diff(places[:, 0]) > 0).all()


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    setting = replace(REDUCED, views=6, swept=2)
    return runs.Workplace(tmp_path_factory.mktemp("paper"), setting, "test")


@pytest.fixture(scope="module")
def scene(area):
    return scenes.Scene("B", area.past, area.present, SMALL)


@pytest.fixture(scope="module")
def made(place, scene):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthonav.ground.build.calibrate.CROPS", 8)  # no confidence is looked at
        return runs.run(place, scene, Method("gradient", "gradient", "gradient"))


def test_band_narrower_than_a_tile_is_one_around_the_route(scene):
    narrow = replace(scene, trajectory=replace(SMALL, band_m=100.0)).area()
    made = Area.from_route(narrow["route"], narrow["band_m"])
    west, south, east, north = made.extent_en_m
    assert (east - west, north - south) == pytest.approx((420, 100), abs=1)
    west, south, east, north = Area.from_bounds(scene.area()["bounds_deg"]).extent_en_m
    assert (east - west, north - south) == pytest.approx((320, 288), abs=1)


@pytest.mark.slow  # an experiment
def test_views_show_the_ground_of_the_map_pixel_by_pixel(place, scene, made):
    localizer = Localizer(open_map(place.work(scene, "gradient-gradient") / "map.onav"))
    same = replace(scene, present=scene.past)
    seen = runs.placements(same, localizer, 3)
    camera = scenes.camera_of(SMALL.agl_m, 1.0)
    for ground in seen["grid"]:
        grey = scenes.view_of(ground, SMALL.agl_m, 1.0)
        found = localizer.locate(View(grey, camera, scenes.telemetry_at(SMALL.agl_m)))
        error = localizer.sheet.frame.en_from_latlon(found.lat_deg, found.lon_deg)
        assert np.hypot(*(error - ground.truth_en_m)) < 3
        lower = scenes.view_of(ground, SMALL.agl_m, 1.0, drop_m=200)
        inner = grey[64:192, 64:192].astype(float)
        assert abs(lower.mean() - inner.mean()) < 20
        turned = scenes.view_of(ground, SMALL.agl_m, 1.0, turned_deg=90)
        # Heading east: the top of the picture is the east of the north-up one.
        assert np.abs(np.rot90(grey).astype(int) - turned).mean() < 3


@pytest.mark.slow  # an experiment
def test_a_run_says_what_it_was_and_is_not_run_twice(place, scene, made, monkeypatch):
    out = place.result(scene, "gradient-gradient")
    written = json.loads(out.read_text())
    assert written == json.loads(json.dumps(made))
    assert {"provenance", "inputs", "minutes", "command", "seeds"} <= set(made)
    assert all(len(digest) == 64 for digest in made["inputs"].values())
    assert len(made["views"]["grid"]) == len(made["views"]["anywhere"]) == 6
    assert len(made["views"]["route"]) == pytest.approx(SMALL.length_m / SMALL.stride_m, abs=1)
    assert set(made["rules"]) == {"grid", "anywhere"}
    assert set(made["sweep"]) == {"heading_deg", "drop_m"}

    def refuse(*_):
        raise AssertionError("built again")

    monkeypatch.setattr(runs, "build_map", refuse)
    assert runs.run(place, scene, Method("gradient", "gradient", "gradient")) == written


@pytest.mark.slow  # an experiment
def test_tables_are_made_of_the_files_alone(tmp_path, made):
    folder = tmp_path / "reduced"
    folder.mkdir()
    plain = json.loads(json.dumps(made))
    plain["method"] = {"family": "autoencoder", "recipe": "autoencoder", "edges": "canny"}
    plain["views"] = {
        "grid": [[0.0, 1, 1.5, 2.0], [14.0, 1, 1.2, 1.9], [99.0, 1, 1.2, 1.1], [None] * 4],
        "anywhere": [[20.0, 1, 1.1, 1.3]] * 4,
        "route": [[1.0, 1, 1.1, 1.3]] * 3,
    }
    (folder / "B-autoencoder-canny.json").write_text(json.dumps(plain))
    text = report(tmp_path, "reduced").read_text()
    rows = [line.split() for line in text.splitlines() if line.startswith("| Auto-Encoder, Canny")]
    accuracy, criterion, accepted = (row[4] for row in rows[:3])
    assert (accuracy, criterion, accepted) == ("100/50/0", "67/75", "25/50")
    assert " 90.2 |" in text and " 99.7/91 |" in text
    assert report(tmp_path, "full") is None


def test_ratios_are_compared_at_equal_accuracy():
    right = np.array([True, True, True, False])
    ratio = np.array([2.0, 1.5, 1.2, 1.1])
    assert confident(right, ratio, 1.13) == (1.0, 0.75)
    assert accepted_at(right, ratio) == 0.75
    assert accepted_at(~right, ratio) == 0.0
    nothing = confident(right, ratio, 9.0)
    assert np.isnan(nothing[0])
    assert nothing[1] == 0


def test_rows_tuned_on_their_scene_are_marked():
    def marked(scene, setting=REDUCED):
        return {each.key for each in methods(setting, scene, 900) if each.tuned_on(scene)}

    words = {"bovw-gray-256", "bovw-gray-1024"}
    ours = {"gradient-gradient", "gradient-gradient-registration"}
    learnt = {f"autoencoder-{edges}" for edges in ("canny", "gray", "segments", "onnx")}
    assert marked("B") == words | ours | learnt | {"triplet-canny", "triplet-gray"}
    assert marked("naip-2018") == words | ours
    for scene in scenes.UNTUNED:
        assert marked(scene) == words
    full = {each for each in marked("B", FULL) if each.startswith(("triplet", "autoencoder"))}
    assert full == {"autoencoder-onnx"}


def test_one_view_per_tile_step_as_many_as_the_paper():
    """B and D are flown in the tile steps of their pixels; C in every third or fourth one."""
    for name in ("B", "D"):
        flown = FULL.trajectory(name)
        assert round(flown.length_m / flown.stride_m + 0.5) == scenes.most_views(name)
    places = scenes.along_route(CENTRES, 500)
    assert np.array_equal(places[:, 0], np.arange(0, 320, 32))
    assert (places[:, 1] == 64).all()
    assert np.array_equal(scenes.along_route(CENTRES, 4)[:, 0], [0, 96, 192, 288])


@pytest.mark.slow
def test_a_dry_run_of_all_rows_ends_without_a_failure(tmp_path):
    arguments = ["--dry-run", "--only", *"ABCD", "baselines", "--jobs", "2", "--device", "cpu"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    rows = {path.stem for path in (tmp_path / "dry-reduced").glob("*.json")}
    assert rows >= {f"{name}-autoencoder-canny" for name in "ABCD"} | {"B-triplet-gray"}
