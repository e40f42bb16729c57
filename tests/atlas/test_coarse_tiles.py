"""Coarse tiles of a sheet: where they lie, what they say, and that nothing else is read as such."""

import json

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from orthonav.core.errors import AtlasError, MissingFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.ground.atlas.catalog import CoarseRecipe, canonical
from orthonav.ground.atlas.coarse import coarse_grid, read_coarse, tiles_in, write_coarse
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.sheets import WorldSheets

RECIPE = CoarseRecipe(gsd_m=1.0, tile_px=64, overlap=0.5)
WORLD = WorldSheets(250.0)


@pytest.fixture(scope="module")
def mosaic(make_ortho, tmp_path_factory):
    rng = np.random.default_rng(3)
    grey = np.kron(rng.integers(20, 235, (80, 80)), np.ones((10, 10))).astype(np.uint8)
    return Mosaic.open([make_ortho(tmp_path_factory.mktemp("ortho") / "wide.tif", grey)])


@pytest.fixture(scope="module")
def middle(mosaic):
    """Latitude and longitude of its centre."""
    outline = mosaic.outline_latlon_deg
    return (outline.min(axis=0) + outline.max(axis=0)) / 2


@pytest.fixture(scope="module")
def box_deg(middle):
    return WORLD.bounds_deg(WORLD.name_at(*middle))


@pytest.fixture(scope="module")
def stored(mosaic, box_deg, tmp_path_factory):
    path = tmp_path_factory.mktemp("coarse") / "sheet.safetensors"
    assert write_coarse(mosaic, box_deg, RECIPE, path) > 20
    return path


def make_coarse(mosaic, box_deg, folder):
    path = folder / "made.safetensors"
    write_coarse(mosaic, box_deg, RECIPE, path)
    return read_coarse(path)


def test_coarse_tiles_are_read_back_and_reproducible(mosaic, box_deg, stored, tmp_path):
    read = read_coarse(stored)
    features, weights = read.features_of(slice(None, None, 3))
    np.testing.assert_array_equal(features, read.features[::3])
    assert weights.shape == features.shape and weights.min() == 1
    write_coarse(mosaic, box_deg, RECIPE, tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == stored.read_bytes()


def test_every_place_is_within_half_a_stride_of_one_centre_of_its_sheet_or_the_next(middle):
    """Neighbouring sheets together leave no gap, and no tile belongs to two."""
    frame = LocalFrame(float(middle[0]), float(middle[1]))
    lat, lon = frame.latlon_from_en(
        np.array([[dx, dy] for dx in (-150, 150) for dy in (-150, 150)])
    )
    names = {WORLD.name_at(*place) for place in zip(lat.tolist(), lon.tolist(), strict=True)}
    centres = []
    for name in sorted(names):
        bounds_deg = WORLD.bounds_deg(name)
        area = Area.from_bounds(bounds_deg)
        grid = coarse_grid(area, RECIPE)
        places = area.frame.latlon_from_en(grid.centres_en_m(tiles_in(bounds_deg, area, grid)))
        assert {WORLD.name_at(*place) for place in np.stack(places, axis=1).tolist()} == {name}
        centres.append(frame.en_from_latlon(*places))
    places = np.random.default_rng(1).uniform(-140, 140, (2000, 2))
    away = np.abs(places[:, None] - np.concatenate(centres)).max(axis=2).min(axis=1)
    half_m = RECIPE.tile_px * RECIPE.gsd_m * (1 - RECIPE.overlap) / 2
    assert away.max() < 1.02 * half_m, "meridians tilt, so a sheet is no exact square"


def test_tiles_with_too_little_imagery_are_left_out(mosaic, middle, tmp_path):
    outline = mosaic.outline_latlon_deg
    corner = WORLD.bounds_deg(WORLD.name_at(*outline.max(axis=0)))
    made = make_coarse(mosaic, corner, tmp_path)
    assert made.valid.min(initial=255) < 255 and (made.valid.mean(axis=1) > 0.45 * 255).all()
    _, weights = made.features_of(slice(None))
    assert weights.shape == made.features.shape
    nowhere = WORLD.bounds_deg(WORLD.name_at(middle[0] + 1, middle[1]))
    assert write_coarse(mosaic, nowhere, RECIPE, tmp_path / "none.safetensors") == 0
    assert len(read_coarse(tmp_path / "none.safetensors").features) == 0


def test_other_files_are_refused(stored, tmp_path):
    data, path = stored.read_bytes(), tmp_path / "bad.safetensors"
    for broken in (b"", b"hello", data[:-1], data[: len(data) // 2], data + b"0", b"{" + data):
        path.write_bytes(broken)
        with pytest.raises(AtlasError, match=r"bad\.safetensors"):
            read_coarse(path)
    with pytest.raises(MissingFileError):
        read_coarse(tmp_path / "absent.safetensors")


def _without(name):
    return lambda arrays, metadata: arrays.pop(name)


def _array(name, change):
    def changed(arrays, metadata):
        arrays[name] = np.ascontiguousarray(change(arrays[name]))

    return changed


def _with(**more):
    return lambda arrays, metadata: metadata.update(more)


@pytest.mark.parametrize(
    "change",
    [
        _without("valid"),
        _array("features", lambda a: a.astype(np.float32)),
        _array("features", lambda a: a[:-1]),
        _array("features", lambda a: np.full_like(a, np.inf)),
        _array("valid", lambda a: a[:, :32]),
        _with(format="other"),
        _with(schema=3),
        _with(more=1),
        _with(recipe={"gsd_m": -1.0, "tile_px": 64, "overlap": 0.5}),
    ],
)
def test_altered_files_are_refused(stored, tmp_path, change):
    arrays = load_file(stored)
    metadata = _metadata(stored)
    change(arrays, metadata)
    path = tmp_path / "altered.safetensors"
    save_file(arrays, path, metadata={"orthonav": canonical(metadata).decode()})
    with pytest.raises(AtlasError, match=r"altered\.safetensors"):
        read_coarse(path)


def _metadata(path):
    data = path.read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return json.loads(header["__metadata__"]["orthonav"])
