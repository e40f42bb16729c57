"""The terrain layer of a map: what was encoded is read, and nothing damaged is believed."""

import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import arrays, manifest

from orthonav.core.errors import MapFileError
from orthonav.core.geo.ground import RELIEF_SLOPES
from orthonav.core.mapfile import open_map, terrain, write_map
from orthonav.core.mapfile.manifest import SheetInfo, TerrainInfo
from orthonav.core.mapfile.reader import blob_parts
from orthonav.core.mapfile.terrain import (
    TerrainLayer,
    decode_terrain,
    encode_terrain,
    terrain_part_names,
)

POSTING_M, ROWS, COLS, CHUNK = 10.0, 40, 50, 16
INFO = TerrainInfo(
    -250.0, 200.0, POSTING_M, ROWS, COLS, CHUNK, 100.0, 900.0, 0.1, ROWS * COLS, "dem.tif", "msl"
)
DATA, OFFSETS = terrain_part_names(0)


def height(east_m, north_m):
    return 400 + 0.8 * np.asarray(east_m) - 0.3 * np.asarray(north_m)


def samples():
    """Heights (rows, cols) of the layer; a corner of it is a hole."""
    col, row = np.meshgrid(np.arange(COLS) + 0.5, np.arange(ROWS) + 0.5)
    heights = height(INFO.west_m + col * POSTING_M, INFO.north_m - row * POSTING_M)
    heights[:20, :20] = np.nan
    return heights.astype(np.float32)


def chunks(heights):
    return [
        encode_terrain(heights[row : row + CHUNK, col : col + CHUNK], INFO)
        for row in range(0, ROWS, CHUNK)
        for col in range(0, COLS, CHUNK)
    ]


def with_terrain(info=INFO):
    plain = manifest()
    return replace(plain, sheets=(replace(plain.sheets[0], terrain=info),))


def write(path, blobs=None, info=INFO, **parts):
    found = blob_parts(DATA, OFFSETS, chunks(samples()) if blobs is None else blobs)
    write_map(path, with_terrain(info), {**arrays(), **found, **parts})
    return path


@pytest.fixture
def layer(tmp_path):
    return TerrainLayer.of(open_map(write(tmp_path / "a.onav")))


def test_heights_are_those_that_were_encoded(layer):
    rng = np.random.default_rng(0)
    points = rng.uniform([-30, -190], [240, -10], (200, 2))
    np.testing.assert_allclose(layer.at_en_m(points), height(*points.T), atol=0.051)
    lat, lon = layer.frame.latlon_from_en(points.reshape(20, 10, 2))
    np.testing.assert_allclose(layer(lat, lon).ravel(), height(*points.T), atol=0.06)
    assert layer.info == INFO


def test_holes_and_what_lies_outside_are_unknown(layer):
    outside = [[-251.0, 0], [251, 0], [0, 201], [0, -201], [np.nan, 0], [-200, 150], [1e9, 1e9]]
    assert np.isnan(layer.at_en_m(np.array(outside))).all()
    assert np.isnan(layer.at_en_m([-46.0, 100.0]))  # beside a hole
    assert np.isfinite(layer.at_en_m([-44.0, 100.0]))


@pytest.mark.parametrize("few", [(1, 10**6), (4, 10**6), (100, 10**6), (4, 30), (4, 0)], ids=str)
def test_heights_do_not_depend_on_how_many_are_read_at_once(layer, monkeypatch, few):
    """Of points in one chunk and across several, beside the hole and outside."""
    rng = np.random.default_rng(2)
    middles = rng.uniform([-260, -210], [260, 210], (60, 2))
    asked = [each + rng.uniform(-reach, reach, (12, 2)) for each in middles for reach in (4, 90)]
    asked += [np.empty((0, 2)), np.array([[np.nan, 0.0], [0.0, 0.0]]), np.array([[1e12, -np.inf]])]
    monkeypatch.setattr(terrain, "FEW_CHUNKS", 0)
    alone = [layer.at_en_m(points) for points in asked]
    assert any(np.isnan(each).any() and np.isfinite(each).any() for each in alone)
    monkeypatch.setattr(terrain, "FEW_CHUNKS", few[0])
    monkeypatch.setattr(terrain, "FEW_SAMPLES", few[1])
    for points, expected in zip(asked, alone, strict=True):
        np.testing.assert_array_equal(layer.at_en_m(points), expected)


@given(
    st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1), st.sampled_from([0, 0.3, 1])
)
def test_any_heights_come_back(rows, cols, seed, holes):
    rng = np.random.default_rng(seed)
    heights = rng.uniform(INFO.low_m, INFO.high_m, (rows, cols)).astype(np.float32)
    heights[rng.random((rows, cols)) < holes] = np.nan
    data = encode_terrain(heights, INFO)
    if not np.isfinite(heights).any():
        assert data == b""
        return
    found = decode_terrain(np.frombuffer(data, np.uint8), (rows, cols), INFO)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(heights))
    np.testing.assert_allclose(found, heights, atol=0.051)


def png(values):
    return cv2.imencode(".png", values)[1].tobytes()


def with_text(png, before):
    """A PNG with a text that inflates to 1 MB before one of its parts."""
    text = b"zTXt" + b"a\0\0" + zlib.compress(bytes(10**6), 9)
    part = (len(text) - 4).to_bytes(4, "big") + text + zlib.crc32(text).to_bytes(4, "big")
    at = png.index(before) - 4
    return png[:at] + part + png[at:]


SIDES = CHUNK, CHUNK
NOISE = png(np.random.default_rng(0).integers(1, 500, SIDES).astype(np.uint16))
DAMAGED = {
    "not a PNG": b"\0" * 40,
    "another size": png(np.ones((CHUNK, CHUNK + 1), np.uint16)),
    "a claim of gigabytes": NOISE[:16] + b"\0\0\xff\xff" * 2 + NOISE[24:],
    "8 bits": png(np.ones(SIDES, np.uint8)),
    "colours": png(np.ones((*SIDES, 3), np.uint16)),
    "cut": NOISE[:-60],
    "a text before the samples": with_text(png(np.ones(SIDES, np.uint16)), b"IDAT"),
    "a text after the samples": with_text(png(np.ones(SIDES, np.uint16)), b"IEND"),
    "bytes after the end": NOISE + bytes(12),
    "interlaced": NOISE[:28] + b"\1" + NOISE[29:],
    "many bytes": NOISE + bytes(4 * CHUNK * CHUNK + 2000),
    "too high": png(np.full(SIDES, 65_535, np.uint16)),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_chunk_is_an_error(tmp_path, name):
    blobs = chunks(samples())
    blobs[-5] = DAMAGED[name]
    layer = TerrainLayer.of(open_map(write(tmp_path / "a.onav", blobs)))
    assert np.isfinite(layer.at_en_m([-40.0, 30.0]))
    with pytest.raises(
        MapFileError, match=r"terrain layer is damaged \(level 0, chunk 1, 3: .*a\.onav"
    ):
        layer.at_en_m([240.0, 0.0])


@settings(max_examples=200)
@given(st.integers(0, len(NOISE)), st.integers(0, 9), st.binary(max_size=9))
def test_whatever_is_done_to_a_chunk_only_our_errors_come_out(at, removed, added):
    changed = NOISE[:at] + added + NOISE[at + removed :]
    try:
        found = decode_terrain(np.frombuffer(changed, np.uint8), SIDES, INFO)
    except MapFileError:
        return
    assert found.shape == SIDES


WRONG = {
    "posting_m": (0.2, 1001.0),
    "rows": (0,),
    "cols": (10**6,),
    "chunk_px": (8,),
    "low_m": (-1000.0, 901.0),
    "high_m": (10_000.0,),
    "unit_m": (0.001, 0.01),
    "known": (ROWS * COLS + 1,),
    "west_m": (1e9,),
    "source_posting_m": (0.0, 1e6),
    "roughness_m": (-0.1, 1001.0),
}


@pytest.mark.parametrize("name, value", [(name, x) for name, all_ in WRONG.items() for x in all_])
def test_impossible_layers_are_refused(tmp_path, name, value):
    path = write(tmp_path / "a.onav", info=replace(INFO, **{name: value}))
    with pytest.raises(MapFileError, match="impossible terrain layer"):
        open_map(path)


def test_heights_of_another_codec_are_named():
    with pytest.raises(MapFileError, match="heights as delta-zlib, png is read; build it again"):
        TerrainInfo.from_plain(INFO.to_plain() | {"codec": "delta-zlib"})


def test_what_the_source_was_like_is_optional(tmp_path):
    finer = replace(INFO, source_posting_m=0.5, roughness_m=2.75)
    assert TerrainInfo.from_plain(finer.to_plain()) == finer
    older = INFO.to_plain()
    assert "roughness_m" not in older and "source_posting_m" not in older
    assert TerrainInfo.from_plain(older) == INFO
    for value in (float("nan"), "2", True):
        with pytest.raises(MapFileError, match="roughness_m must be a finite number"):
            TerrainInfo.from_plain(older | {"roughness_m": value})


def test_relief_is_stated_or_not(tmp_path):
    plain = manifest().sheets[0]
    assert "relief" not in plain.to_plain()
    for relief in (None, *RELIEF_SLOPES):
        stated = replace(plain, relief=relief)
        assert SheetInfo.from_plain(stated.to_plain()) == stated
    for value in ("steep", 3, ["level"]):
        with pytest.raises(MapFileError, match="relief"):
            SheetInfo.from_plain(plain.to_plain() | {"relief": value})


@pytest.mark.parametrize(
    "parts",
    [
        {OFFSETS: np.zeros(3, np.int64)},
        {OFFSETS: np.zeros(13, np.int64)},
        {OFFSETS: np.zeros(13, np.int32)},
        {DATA: np.zeros((0, 2), np.uint8)},
    ],
)
def test_parts_that_do_not_fit_are_refused(tmp_path, parts):
    opened = open_map(write(tmp_path / "a.onav", **parts))
    with pytest.raises(MapFileError, match="terrain"):
        TerrainLayer.of(opened)
