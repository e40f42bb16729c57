"""A built map: covers its area, is the same every time, and is written whole or not at all."""

import errno
import os
import signal
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import pytest
from builders import WITH_LAYER, built

from helpers import box_deg, textured, waypoints
from orthonav.core.cores import AHEAD, in_order
from orthonav.core.errors import AreaError, ImageryError, OutputError, UsageError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.swapped import HINT
from orthonav.core.localize.confidence import LogisticConfidence, RegisteredConfidence
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, Telemetry, View
from orthonav.ground.build import BuildRequest, build_map
from orthonav.ground.build.calibrate import CALIBRATION
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route

CAMERA = Camera(256, 256, 256.0, 256.0, 128.0, 128.0)
"""It sees as many metres of ground as it is above it."""


@pytest.fixture(scope="module")
def ortho(make_ortho, tmp_path_factory):
    """An orthophoto of 400 x 400 m, all valid."""
    return make_ortho(tmp_path_factory.mktemp("ortho") / "2019-06.tif")


@pytest.fixture(scope="module")
def small_ortho(make_ortho, tmp_path_factory):
    """One of 220 x 220 m, where the area does not matter: its maps are built in less time."""
    grey = textured((220, 220))
    return make_ortho(tmp_path_factory.mktemp("small") / "2019-06.tif", grey)


@pytest.fixture(scope="module")
def frame(ortho):
    """The plane of a map of the whole of it."""
    outline = Mosaic.open([ortho]).outline_latlon_deg
    return Area.from_outline(outline[:, 0], outline[:, 1]).frame


@pytest.fixture(autouse=True)
def fewer_crops(map_path, monkeypatch):
    """Calibration from few crops and views, but for the map that all tests share."""
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 24)
    monkeypatch.setattr("orthonav.ground.build.calibrate.ENOUGH_RIGHT", 1)


def centres_en_m(opened):
    return opened.array("sheet0/centres_en_m", np.float32, 2).astype(float)


def farthest_m(points_en_m, opened, frame):
    """Distance per axis (Chebyshev) of each point (N, 2) of `frame` to the nearest tile centre."""
    sheet = opened.manifest.sheets[0]
    points = sheet.frame.en_from_latlon(*frame.latlon_from_en(points_en_m))
    offset = np.abs(points[:, None] - centres_en_m(opened)[None]).max(axis=2)
    return offset.min(axis=1)


def inside_band(points_en_m, a, b, half_m):
    along = np.clip(((points_en_m - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(points_en_m - (a + along[:, None] * (b - a)), axis=1) <= half_m


def random_points(west_m, south_m, east_m, north_m, count=2000):
    return np.random.default_rng(0).uniform([west_m, south_m], [east_m, north_m], (count, 2))


REQUESTS = {
    "gray": {"edges": "gray"},
    "canny": {"edges": "canny:low=50,high=120"},
    "both": {"method": "gradient:dims=32,cells=16", "edges": "canny"},
    "seed": {**WITH_LAYER, "seed": 5, "calibration_views": 3},
}


@pytest.mark.parametrize("request_", REQUESTS.values(), ids=REQUESTS.keys())
def test_the_same_request_gives_the_same_bytes(small_ortho, tmp_path, names_in, request_):
    first = built(small_ortho, tmp_path, "a.onav", **request_)
    again = built(small_ortho, tmp_path, "b.onav", **request_)
    assert first.path.read_bytes() == again.path.read_bytes()
    assert names_in(tmp_path) == ["a.onav", "b.onav"]
    recipe = first.manifest.recipe
    assert recipe["overlap"] == 0.75 and recipe["seed"] == request_.get("seed", 0)


def test_the_whole_imagery_is_covered(ortho, tmp_path, frame):
    """A tile needs imagery under half of it, so corners of the imagery are left out."""
    opened = built(ortho, tmp_path)
    points = random_points(-195, -195, 195, 195)
    points = points[np.abs(points).min(axis=1) < 195 - 32]
    grid = opened.manifest.sheets[0].grid
    assert farthest_m(points, opened, frame).max() <= grid.stride_m / 2 + 0.01
    assert opened.manifest.sheets[0].area_km2 == pytest.approx(0.16, rel=0.1)


@pytest.mark.parametrize("tile_px, overlap", [(64, 0.0), (96, 0.5), (64, 0.75), (96, 0.9)])
def test_bounds_are_covered(ortho, tmp_path, frame, tile_px, overlap):
    box = (-120.0, -60.0, 77.3, 131.9)
    opened = built(
        ortho, tmp_path, bounds_deg=box_deg(frame, *box), overlap=overlap, tile_px=tile_px
    )
    sheet = opened.manifest.sheets[0]
    # To whole micro-cells, of which 32 make a tile.
    assert abs(sheet.grid.stride_px - tile_px * (1 - overlap)) <= tile_px / 64 + 1e-9
    assert sheet.grid.stride_px % (tile_px // 32) == 0
    assert farthest_m(random_points(*box), opened, frame).max() <= sheet.grid.stride_m / 2 + 0.01
    reach = sheet.grid.stride_m
    centres = frame.en_from_latlon(*sheet.frame.latlon_from_en(centres_en_m(opened)))
    assert (centres > np.array(box[:2]) - reach).all()
    assert (centres < np.array(box[2:]) + reach).all()


def test_a_band_around_a_route_is_covered(ortho, tmp_path, frame):
    a, b = np.array([-110.0, -90.0]), np.array([100.0, 60.0])
    opened = built(
        ortho, tmp_path, route=Route(waypoints(frame, [a, b])), band_m=80.0, overlap=0.875
    )
    points = random_points(-160, -140, 150, 110)
    near = inside_band(points, a, b, 40.0)
    stride_m = opened.manifest.sheets[0].grid.stride_m
    assert 100 < near.sum() < 1500
    assert farthest_m(points[near], opened, frame).max() <= stride_m / 2 + 0.01
    sheet = opened.manifest.sheets[0]
    centres = frame.en_from_latlon(*sheet.frame.latlon_from_en(centres_en_m(opened)))
    assert inside_band(centres, a, b, 40.0 + stride_m).all()
    assert sheet.tiles == len(centres) < sheet.grid.rows * sheet.grid.cols / 2


def test_blocks_do_not_matter(small_ortho, tmp_path, monkeypatch):
    whole = built(small_ortho, tmp_path, "a.onav")
    monkeypatch.setattr("orthonav.ground.build.sheet.BLOCK_PX", 90)
    blocks = built(small_ortho, tmp_path, "b.onav")
    scores = np.einsum(
        "nd,nd->n",
        *(m.array("sheet0/embeddings", np.float16, 2).astype(float) for m in (whole, blocks)),
    )
    assert scores.min() > 0.995
    np.testing.assert_array_equal(centres_en_m(whole), centres_en_m(blocks))


@pytest.mark.parametrize("tile_px", [64, 96], ids=["chunks in one block", "chunks over blocks"])
def test_any_number_of_workers_gives_the_same_bytes(make_ortho, tmp_path, monkeypatch, tile_px):
    grey = textured((300, 300))
    grey[75:172, 98:142] = 0
    ortho = make_ortho(tmp_path / "2019.tif", grey, nodata=0)
    monkeypatch.setattr("orthonav.ground.build.sheet.BLOCK_PX", 128)
    for workers in (1, 3):
        built(ortho, tmp_path, f"{workers}.onav", tile_px=tile_px, workers=workers, **WITH_LAYER)
    assert (tmp_path / "1.onav").read_bytes() == (tmp_path / "3.onav").read_bytes()


@pytest.mark.parametrize("workers", [1, 3])
def test_the_first_error_is_raised_and_no_thread_stays(workers):
    before = threading.active_count()

    def failing(item):
        time.sleep(0.002 * (5 - item % 6))  # later ones are first
        if item in (7, 8):
            raise ImageryError(f"item {item}")
        return item

    found = []
    with pytest.raises(ImageryError, match="item 7"):
        for item in in_order(failing, range(20), workers):
            found.append(item)
    assert found == list(range(7)) and threading.active_count() == before


def test_few_results_wait_for_a_reader():
    started = []
    results = in_order(started.append, range(100), 3)
    next(results)
    time.sleep(0.05)
    assert len(started) <= 3 + AHEAD
    results.close()


def test_the_manifest(small_ortho, tmp_path):
    calls, out = [], tmp_path / "deep" / "map.onav"
    request = BuildRequest([small_ortho], out, tile_px=64, calibration_views=4)
    result = build_map(request, lambda stage, share: calls.append((stage, share)))
    manifest = open_map(out).manifest
    assert manifest == result.manifest and result.size_bytes == out.stat().st_size
    assert manifest.imagery[0]["date"] == "2019-06" and manifest.imagery[0]["name"] == "2019-06.tif"
    assert manifest.radius_m == CALIBRATION.radius_strides * manifest.sheets[0].grid.stride_m
    stages = ["imagery", "learn", "calibrate", "calibrate registration"]
    assert list(dict.fromkeys(stage for stage, _ in calls)) == stages
    assert all(0 <= share <= 1 for _, share in calls) and calls[-1] == (stages[-1], 1.0)


ROUTE = Route(((46.0, 2.0), (46.001, 2.001)))
REFUSED = [
    ({"bounds_deg": (2, 46, 3, 47), "route": ROUTE}, "not both"),
    ({"band_m": 100.0}, "needs a route"),
    ({"route": ROUTE}, "--band-m"),
    ({"route": ROUTE, "band_m": 0.0}, "wider than 0"),
    ({"route": ROUTE, "band_m": 100.0}, "no imagery"),
    ({"bounds_deg": (3000, 3000, 3100, 3100)}, "the orthophotos cover"),
    ({"bounds_deg": (250, -50, 350, 50)}, "no imagery"),
    ({"bounds_deg": (3, 46, 2, 47)}, "west < east"),
    ({"tile_px": 1024}, "larger than the area"),
    ({"gsd_m": 20.0}, "larger than the area"),
    ({"tile_px": 8}, "16 to 4096"),
    ({"tile_px": 100}, "multiple of 32"),
    *(({"overlap": wrong}, "overlap") for wrong in (1.0, -0.5, float("nan"))),
    *(({"gsd_m": wrong}, "gsd_m must be") for wrong in (-1.0, 0.0, float("nan"))),
    ({"method": "magic"}, "unknown variant 'magic'"),
    ({"edges": "canny:low=x"}, "low"),
    ({"method": "gradient:size=3"}, "size"),
]
"""Bounds beyond 180 are metres."""


@pytest.mark.parametrize("request_, message", REFUSED)
def test_what_cannot_be_built(ortho, tmp_path, frame, names_in, request_, message):
    box = request_.get("bounds_deg", (0,))
    if max(box) > 180:
        request_ = {"bounds_deg": box_deg(frame, *box)}
    with pytest.raises((UsageError, AreaError), match=message):
        built(ortho, tmp_path, **request_)
    assert names_in(tmp_path) == []


def test_bounds_may_begin_at_the_antimeridian_in_the_imagery(make_ortho, tmp_path):
    centred = "+proj=aeqd +lat_0=-17 +lon_0=180 +x_0=700203 +y_0=6599800 +datum=WGS84"
    ortho = make_ortho(tmp_path / "fiji.tif", textured((400, 400)), crs=centred)
    for west, east in ((-180.0, -179.9985), (179.9985, 180.0)):
        opened = built(ortho, tmp_path, bounds_deg=(west, -17.001, east, -16.999))
        assert 0.03 < opened.manifest.area_km2 < 0.06


def test_a_uniform_orthophoto_is_no_crash(make_ortho, tmp_path):
    """Nothing to learn from: the usual confidence, which without a margin is low."""
    flat = make_ortho(tmp_path / "flat.tif", np.full((300, 300), 99, np.uint8))
    opened = built(flat, tmp_path)
    confidence = LogisticConfidence.from_plain(opened.manifest.confidence)
    assert confidence({"score": 0.9, "margin": 0.0}) < 0.9
    assert opened.manifest.view["position_std_m"] > 0


@pytest.mark.parametrize("side_px", [96, 130])
def test_a_small_map_states_confidence(make_ortho, tmp_path, side_px):
    """With a registration layer or not; of one tile and of a few."""
    rng = np.random.default_rng(side_px)
    small = make_ortho(tmp_path / "small.tif", rng.integers(0, 255, (side_px,) * 2, np.uint8))
    opened = built(small, tmp_path, tile_px=96, **WITH_LAYER)
    tiles = LogisticConfidence.from_plain(opened.manifest.confidence)
    RegisteredConfidence.from_plain(opened.manifest.registration["confidence"])
    assert tiles({"score": 0.3, "margin": 0.0}) < 0.5


@pytest.mark.parametrize("old", [None, b"an older map"])
def test_a_full_disk_leaves_nothing_new(small_ortho, tmp_path, names_in, monkeypatch, old):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    out = tmp_path / "out" / "map.onav"
    out.parent.mkdir()
    if old is not None:
        out.write_bytes(old)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="disk full"):
        built(small_ortho, out.parent, **WITH_LAYER)
    assert names_in(out.parent) == ([] if old is None else ["map.onav"])
    assert old is None or out.read_bytes() == old


@pytest.mark.parametrize("stage", ["imagery", "learn", "calibrate"])
def test_an_interrupt_leaves_nothing(small_ortho, tmp_path, names_in, stage):
    def progress(now, share):
        if now == stage and share > 0.3:
            raise KeyboardInterrupt

    request = BuildRequest([small_ortho], tmp_path / "out" / "map.onav", tile_px=64)
    with pytest.raises(KeyboardInterrupt):
        build_map(request, progress)
    assert names_in(tmp_path) == []


KILLED = """
import os, signal, sys
from orthonav.ground.build import BuildRequest, build_map

def kill(*_):
    os.kill(os.getpid(), signal.SIGKILL)

def progress(stage, share):
    if stage == sys.argv[3]:
        kill()

if sys.argv[3] == "write":
    os.fsync = kill
small = {"tile_px": 64, "overlap": 0.75, "registration": False}
build_map(BuildRequest([sys.argv[1]], sys.argv[2], **small), progress)
"""


@pytest.mark.long
@pytest.mark.parametrize("stage, left", [("imagery", 0), ("write", 1)])
def test_a_killed_build_keeps_the_old_map(small_ortho, tmp_path, names_in, stage, left):
    out = tmp_path / "map.onav"
    out.write_bytes(b"an older map")
    command = [sys.executable, "-c", KILLED, small_ortho, out, stage]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    assert out.read_bytes() == b"an older map"
    temporaries = [name for name in names_in(tmp_path) if name != out.name]
    assert [name.startswith(".map.onav.") for name in temporaries] == [True] * left
    assert built(small_ortho, tmp_path).manifest.sheets[0].tiles > 0


def own_views(localizer, path, mirrored=False, count=14):
    """Fixes of views cut from the imagery of a map, mirrored or not, with their true places."""
    grid, rng = localizer.grid, np.random.default_rng(3)
    width_m, height_m = grid.width_px * grid.gsd_m, grid.height_px * grid.gsd_m
    corner = np.array([grid.west_m, grid.north_m])
    fixes, truth = [], []
    size = round(grid.tile_m * 1.3)
    with Mosaic.open([path]).sheet(
        localizer.sheet.frame,
        west_m=corner[0],
        north_m=corner[1],
        width_px=int(width_m),
        height_px=int(height_m),
        gsd_m=1.0,
    ) as raster:
        while len(fixes) < count:
            row, col = rng.integers(0, [int(height_m) - size, int(width_m) - size])
            pixels = raster.read(int(col), int(row), size, size)
            if not pixels.valid.all():
                continue
            grey = cv2.resize(pixels.grey, (256, 256), interpolation=cv2.INTER_AREA)
            grey = np.ascontiguousarray(grey[:, ::-1]) if mirrored else grey
            fix = localizer.locate(View(grey, CAMERA, Telemetry(0, 0.0, 0.0, 0.0, float(size))))
            assert isinstance(fix, Fix)
            fixes.append(fix)
            truth.append(corner + np.array([col + size / 2, -(row + size / 2)]))
    return fixes, np.array(truth)


def test_own_views_are_confident_and_mirrored_ones_are_not(localizer, area):
    fixes, truth = own_views(localizer, area.past)
    places = [localizer.sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg) for fix in fixes]
    errors_m = np.abs(np.array(places) - truth).max(axis=1)
    own = np.array([fix.confidence for fix in fixes])
    false = np.array([fix.confidence for fix in own_views(localizer, area.past, True, 7)[0]])
    assert (errors_m <= localizer.grid.stride_m).mean() >= 0.95
    assert np.median(own) > 0.8 and np.median(false) < 0.4
    assert (false[:, None] < own).mean() > 0.97  # nearly every pair is separated
    assert np.isfinite(own).all() and own.min() >= 0 and max(own.max(), false.max()) <= 1


@pytest.mark.parametrize("kind", ["bounds", "route"])
def test_swapped_latitude_and_longitude_are_named(ortho, tmp_path, frame, kind):
    lat, lon = frame.lat_deg, frame.lon_deg
    area = (
        {"bounds_deg": (lat - 0.001, lon - 0.001, lat + 0.001, lon + 0.001)}
        if kind == "bounds"
        else {"route": Route(((lon, lat), (lon + 0.001, lat))), "band_m": 100.0}
    )
    with pytest.raises(AreaError, match=HINT):
        built(ortho, tmp_path, **area)
    assert not any(tmp_path.iterdir())
