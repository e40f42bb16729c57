"""The registration layer as built: the pyramid is exact, however its blocks come, and small."""

import cv2
import numpy as np
import pytest
from builders import WITH_LAYER, built

from helpers import textured, waypoints
from orthonav.core.mapfile import GreyLayer
from orthonav.core.mapfile.layer import part_names
from orthonav.ground.build.layer import (
    CHUNK_PX,
    MAX_BYTES_PER_PX,
    GreyLayerWriter,
    halved,
)
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import Route

NAMES = part_names(0)


@pytest.fixture(autouse=True)
def fewer_crops(monkeypatch):
    """Calibration from few crops."""
    monkeypatch.setattr("orthonav.ground.build.calibrate.CROPS", 16)


def holes(shape, seed=0):
    """Grey and valid (H, W) with borders and holes of many sizes."""
    blots = textured(shape, seed + 1)
    valid = (blots > 90) & (np.add.outer(np.arange(shape[0]), np.arange(shape[1])) > 60)
    return np.where(valid, textured(shape, seed), 0).astype(np.uint8), valid


def naively_halved(grey, valid):
    """As the format says, pixel by pixel."""
    height, width = grey.shape
    small = np.zeros((-(-height // 2), -(-width // 2)), np.uint8)
    kept = np.zeros(small.shape, bool)
    for row in range(small.shape[0]):
        for col in range(small.shape[1]):
            part = np.s_[2 * row : 2 * row + 2, 2 * col : 2 * col + 2]
            under = grey[part][valid[part]].astype(int)
            if len(under) >= 2:
                small[row, col] = int(under.sum() / len(under) + 0.5)
                kept[row, col] = True
    return small, kept


def written(grey, valid, chunk_px=CHUNK_PX, steps=None, order=None):
    """The layer of a picture handed over in blocks of `steps` rows and columns."""
    writer = GreyLayerWriter(*grey.shape, chunk_px=chunk_px)
    steps = steps or grey.shape
    corners = [
        (row, col)
        for row in range(0, grey.shape[0], steps[0])
        for col in range(0, grey.shape[1], steps[1])
    ]
    for index in range(len(corners)) if order is None else order.permutation(len(corners)):
        row, col = corners[index]
        part = np.s_[row : row + steps[0], col : col + steps[1]]
        writer.add(row, col, grey[part], valid[part])
    return writer.finish()


def total_bytes(parts):
    return sum(part.nbytes for part in parts.values())


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (8, 8), (9, 6), (37, 51)])
def test_halving(shape):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        grey = rng.integers(0, 256, shape).astype(np.uint8)
        valid = rng.random(shape) < (0.3, 0.7, 1.1)[seed]
        for found, wanted in zip(halved(grey, valid), naively_halved(grey, valid), strict=True):
            assert found.dtype == wanted.dtype
            np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("steps", [(32, 32), (64, 128), (1, 237), (150, 5), (33, 47), (100, 100)])
def test_how_the_blocks_come_does_not_matter(steps):
    grey, valid = holes((150, 237))
    info, parts = written(grey, valid, chunk_px=32)
    for order in (None, np.random.default_rng(0)):
        other_info, other = written(grey, valid, chunk_px=32, steps=steps, order=order)
        assert other_info == info and other.keys() == parts.keys()
        for name, part in parts.items():
            assert part.dtype == other[name].dtype
            np.testing.assert_array_equal(part, other[name])


@pytest.mark.parametrize("levels", [256, 2])
def test_noise_cannot_make_it_large(levels):
    noise = np.random.default_rng(0).integers(0, levels, (700, 600))
    grey = (noise * (255 // (levels - 1))).astype(np.uint8)
    parts = written(grey, np.ones(grey.shape, bool))[1]
    assert total_bytes(parts) < 4 / 3 * MAX_BYTES_PER_PX * grey.size
    holed = written(grey, np.random.default_rng(1).random(grey.shape) < 0.7)[1]
    assert total_bytes(holed) < 0.8 * grey.size


@pytest.fixture(scope="module")
def ortho(make_ortho, tmp_path_factory):
    """An orthophoto of 260 x 260 m with a hole."""
    grey = textured((260, 260))
    grey[90:140, 100:160] = 0
    return make_ortho(tmp_path_factory.mktemp("ortho") / "2019-06.tif", grey, nodata=0)


@pytest.fixture(scope="module")
def small_map(ortho, tmp_path_factory):
    """A map of it, for tests that only read one; not to be changed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orthonav.ground.build.calibrate.CROPS", 16)
        return built(ortho, tmp_path_factory.mktemp("map"), **WITH_LAYER)


@pytest.mark.parametrize("block_px", [1024, 150])
def test_a_map_carries_its_imagery(ortho, tmp_path, monkeypatch, block_px):
    monkeypatch.setattr("orthonav.ground.build.sheet.BLOCK_PX", block_px)
    opened = built(ortho, tmp_path, **WITH_LAYER)
    sheet, layer = opened.manifest.sheets[0], GreyLayer.of(opened)
    with Mosaic.open([ortho]).grid_sheet(sheet.frame, sheet.grid) as raster:
        pixels = raster.read(0, 0, sheet.grid.width_px, sheet.grid.height_px)
    grey, valid = layer.read(0, 0, 0, *layer.shape(0))
    assert layer.shape(0) == pixels.grey.shape
    assert (valid != pixels.valid).mean() < (1e-3 if block_px < 1024 else 1e-9)
    assert sheet.grey.valid_px == valid.sum() and 0.5 < valid.mean() < 0.98
    error = grey.astype(float)[valid] - pixels.grey[valid]
    assert np.sqrt((error**2).mean()) < 7
    assert max(layer.shape(layer.levels - 1)) <= 64


def test_levels_are_aligned(small_map):
    layer = GreyLayer.of(small_map)
    grey, valid = layer.read(0, 0, 0, *layer.shape(0))
    for level in range(1, layer.levels):
        grey, valid = halved(grey, valid)
        read, read_valid = layer.read(level, 0, 0, *layer.shape(level))
        np.testing.assert_array_equal(read_valid, valid)
        match = cv2.matchTemplate(np.pad(read, 2), grey, cv2.TM_CCOEFF_NORMED)
        assert np.unravel_index(match.argmax(), match.shape) == (2, 2)
        assert match.max() > 0.97


def test_far_from_the_route_there_is_nothing(make_ortho, tmp_path):
    grey = textured((900, 900))
    wide = make_ortho(tmp_path / "wide.tif", grey)
    outline = Mosaic.open([wide]).outline_latlon_deg
    frame = Area.from_outline(outline[:, 0], outline[:, 1]).frame
    route = Route(waypoints(frame, [[-400.0, -400.0], [400.0, 400.0]]))
    opened = built(wide, tmp_path, route=route, band_m=100.0, **WITH_LAYER)
    layer = GreyLayer.of(opened)
    rows, cols = layer.shape(0)
    middle = layer.read(0, rows // 2 - 100, cols // 2 - 100, 200, 200)[1]
    assert middle.all() and not layer.read(0, 0, 0, 250, 250)[1].any()
    sheet = opened.manifest.sheets[0]
    assert sheet.grey.valid_px < 0.7 * rows * cols
    half = sheet.grid.tile_px // 2
    for east_m, north_m in opened.array("sheet0/centres_en_m", np.float32, 2)[::9]:
        row, col = int(sheet.grid.north_m - north_m), int(east_m - sheet.grid.west_m)
        assert layer.read(0, row - half, col - half, 2 * half, 2 * half)[1].mean() > 0.4
