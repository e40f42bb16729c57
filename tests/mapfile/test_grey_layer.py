"""Windows of the registration layer are read right, from no more than is needed, or refused."""

import dataclasses
import shutil
import zlib
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import altered_sheet, arrays, manifest, put_together, taken_apart

from helpers import memory_below, textured
from orthonav.core.errors import MapFileError
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile import GreyLayer, open_map, write_map
from orthonav.core.mapfile import layer as layer_module
from orthonav.core.mapfile.layer import ChunkTable, part_names
from orthonav.core.mapfile.reader import blob_parts
from orthonav.ground.build.layer import GreyLayerWriter

SHAPE, CHUNK_PX = (150, 210), 64
NAMES = part_names(0)


def imagery():
    """Grey and valid of `SHAPE`: a slanted border, a hole, a chunk without any imagery."""
    grey = textured(SHAPE)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    valid = (rows + cols > 40) & (np.hypot(rows - 90, cols - 150) > 20)
    valid[64:128, 64:128] = False
    return np.where(valid, grey, 0).astype(np.uint8), valid


def layer_parts(grey, valid):
    writer = GreyLayerWriter(*grey.shape, chunk_px=CHUNK_PX)
    writer.add(0, 0, grey, valid)
    return writer.finish()


def write_layer(path, info, parts):
    """A map of `SHAPE` with a layer."""
    grid = TileGrid(-75.0, 75.0, 1.0, 16, 1, SHAPE[0] - 15, SHAPE[1] - 15)
    plain = manifest()
    sheet = dataclasses.replace(plain.sheets[0], grid=grid, grey=info)
    write_map(path, dataclasses.replace(plain, sheets=(sheet,)), {**arrays(), **parts})
    return open_map(path)


@pytest.fixture(scope="module")
def made():
    """What the manifest says of the layer, and its parts."""
    return layer_parts(*imagery())


@pytest.fixture(scope="module")
def opened(made, tmp_path_factory):
    """A map with the layer."""
    return write_layer(tmp_path_factory.mktemp("layer") / "area.onav", *made)


@pytest.fixture
def layer(opened):
    """The layer, nothing decoded yet."""
    return GreyLayer.of(opened)


@pytest.fixture
def decoded(monkeypatch):
    """Shapes of the chunks that have been decoded."""
    shapes, decode = [], layer_module.decode_chunk

    def counted(jpeg, mask, shape):
        shapes.append(shape)
        return decode(jpeg, mask, shape)

    monkeypatch.setattr(layer_module, "decode_chunk", counted)
    return shapes


def whole(layer, level):
    return layer.read(level, 0, 0, *layer.shape(level))


def test_what_was_written_comes_back(layer):
    grey, valid = imagery()
    read, read_valid = whole(layer, 0)
    assert read.dtype == np.uint8 and read_valid.dtype == bool
    np.testing.assert_array_equal(read_valid, valid)
    assert (read[~valid] == 0).all()
    error = read.astype(float) - grey
    assert np.sqrt((error[valid] ** 2).mean()) < 6 and abs(error[valid].mean()) < 0.5


@settings(max_examples=150)
@given(
    level=st.integers(0, 2),
    row=st.integers(-80, 200),
    col=st.integers(-80, 260),
    size=st.tuples(st.integers(0, 200), st.integers(0, 300)),
)
def test_any_window(opened, level, row, col, size):
    layer = GreyLayer.of(opened)
    grey, valid = (np.pad(each, 600) for each in whole(layer, level))
    part = np.s_[600 + row : 600 + row + size[0], 600 + col : 600 + col + size[1]]
    found_grey, found_valid = layer.read(level, row, col, *size)
    np.testing.assert_array_equal(found_grey, grey[part])
    np.testing.assert_array_equal(found_valid, valid[part])
    assert found_grey.flags.writeable and found_valid.flags.writeable


def test_only_the_chunks_touched_are_decoded_and_once(decoded, layer):
    layer.read(0, 3, 130, 60, 60)
    assert decoded == [(64, 64)]
    layer.read(0, 0, 128, 64, 64)
    assert len(decoded) == 1
    layer.read(0, 60, 190, 8, 8)
    assert decoded[1:] == [(64, 18), (64, 64), (64, 18)]  # the fourth is there already
    layer.read(0, 70, 70, 50, 50)  # no imagery: nothing is stored
    assert len(decoded) == 4
    layer.read(2, 0, 0, 38, 53)
    assert decoded[4:] == [(38, 53)]


def test_threads_may_share_it(opened):
    layer = GreyLayer.of(opened, cache_bytes=4 * CHUNK_PX**2)
    expected = whole(layer, 0)[0]

    def check(seed):
        rng = np.random.default_rng(seed)
        for _ in range(60):
            row, col = (int(rng.integers(size)) for size in SHAPE)
            grey = layer.read(0, row, col, 40, 40)[0]
            wanted = expected[row : row + 40, col : col + 40]
            np.testing.assert_array_equal(grey[: wanted.shape[0], : wanted.shape[1]], wanted)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(check, range(4)))


def test_a_map_without_a_layer(tmp_path):
    write_map(tmp_path / "area.onav", manifest(), arrays())
    opened = open_map(tmp_path / "area.onav")
    assert opened.manifest.sheets[0].grey is None and GreyLayer.of(opened) is None
    header, plain, data = taken_apart(opened.path)
    del plain["sheets"][0]["grey"]
    older = open_map(put_together(tmp_path / "older.onav", header, plain, data))
    assert GreyLayer.of(older) is None
    for sheet in (1, -1):
        with pytest.raises(MapFileError, match="map has 1 sheets"):
            GreyLayer.of(opened, sheet)


WRONG = {
    "codec": ("webp", None),
    "chunk_px": (0, 65, 8, 2048, 64.0),
    "levels": (0, 11, True),
    "quality": (0, 101),
    "valid_px": (-1, 150 * 210 + 1, "all"),
}


@pytest.mark.parametrize("name, value", [(name, x) for name, all_ in WRONG.items() for x in all_])
def test_a_signed_layer_of_nonsense(opened, tmp_path, name, value):
    path = Path(shutil.copy(opened.path, tmp_path / "odd.onav"))
    grey = taken_apart(path)[1]["sheets"][0]["grey"]
    with pytest.raises(MapFileError, match=r"registration layer|manifest of the map"):
        open_map(altered_sheet(path, grey={**grey, name: value}))


@pytest.mark.parametrize("grey", [[], "grey", 5])
def test_a_layer_that_is_no_record(opened, tmp_path, grey):
    path = Path(shutil.copy(opened.path, tmp_path / "odd.onav"))
    with pytest.raises(MapFileError, match="manifest of the map"):
        open_map(altered_sheet(path, grey=grey))


def one_set(at, value):
    return lambda places: np.where(np.arange(len(places)) == at % len(places), value, places)


@pytest.mark.parametrize("kind", ["offsets", "mask_offsets"])
@pytest.mark.parametrize(
    "change",
    [
        *(one_set(at, value) for at, value in ((0, -1), (0, 1), (-1, 2**62), (3, 2**62))),
        one_set(3, -(2**63)),
        lambda places: places[:-1],
        lambda places: np.append(places, places[-1]),
        lambda places: places[:0],
        lambda places: places.astype(np.int32),
        lambda places: places[None],
        lambda places: places[::-1],
        lambda places: places + 1,
    ],
    ids=range(12),
)
def test_wrong_offsets(made, tmp_path, kind, change):
    info, parts = made
    wrong = {**parts, NAMES[kind]: change(parts[NAMES[kind]])}
    with pytest.raises(MapFileError, match=r"grey/(mask_)?offsets must .*odd.onav"):
        GreyLayer.of(write_layer(tmp_path / "odd.onav", info, wrong))


@pytest.mark.parametrize("kind", NAMES)
def test_missing_parts(made, tmp_path, kind):
    info, parts = made
    left = {name: part for name, part in parts.items() if name != NAMES[kind]}
    with pytest.raises(MapFileError, match=f"{NAMES[kind]} must"):
        GreyLayer.of(write_layer(tmp_path / "odd.onav", info, left))


def with_chunk(parts, number, kind="", *, blob):
    """The parts with the JPEG of a chunk replaced, or with its mask (`kind` is "mask_")."""
    data, offsets = NAMES[f"{kind}bytes"], NAMES[f"{kind}offsets"]
    stored = parts[data].tobytes()
    blobs = [stored[first:last] for first, last in pairwise(parts[offsets])]
    blobs[number] = blob
    return {**parts, **blob_parts(data, offsets, blobs)}


def image(shape=(64, 64), extension=".jpg", options=()):
    picture = textured(shape[:2])
    picture = picture if len(shape) == 2 else np.dstack([picture] * shape[2])
    return cv2.imencode(extension, picture, list(options))[1].tobytes()


GOOD = image()


def framed(rows, cols, *, bits=8, channels=1, marker=0xC0):
    """A grey JPEG that declares something else of itself."""
    data = bytearray(image())
    at = data.index(b"\xff\xc0")
    data[at + 1], data[at + 4], data[at + 9] = marker, bits, channels
    data[at + 5 : at + 9] = rows.to_bytes(2, "big") + cols.to_bytes(2, "big")
    return bytes(data)


def with_segment(marker, content):
    length = (len(content) + 2).to_bytes(2, "big")
    return b"".join([GOOD[:2], bytes([0xFF, marker]), length, content, GOOD[2:]])


JPEGS = {
    "junk": b"\x93" * 500,
    "one byte": b"\xff",
    "only a beginning": b"\xff\xd8\xff",
    "nothing between": b"\xff\xd8\xff\xd9",
    "cut": GOOD[:200],
    "cut at the end": GOOD[:-1],
    "more behind": GOOD + b"more",
    "other size": image((64, 63)),
    "larger": image((128, 128)),
    "colour": image((64, 64, 3)),
    "progressive": image(options=(cv2.IMWRITE_JPEG_PROGRESSIVE, 1)),
    "PNG": image(extension=".png"),
    "WebP": image(extension=".webp"),
    "huge": framed(65_535, 65_535),
    "empty": framed(0, 0),
    "twelve bits": framed(64, 64, bits=12),
    "three channels": framed(64, 64, channels=3),
    "lossless": framed(64, 64, marker=0xC3),
    "arithmetic": framed(64, 64, marker=0xC9),
    "no frame": GOOD.replace(b"\xff\xc0", b"\xff\xe0"),
    "turned": with_segment(
        0xE1, b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0"
    ),
    "empty segments": b"\xff\xd8" + b"\xff\xdb\0\0" * 9 + GOOD[2:],
    "no end of segments": b"\xff\xd8" + b"\xff\xdb\xff\xff" + GOOD[2:],
    "two frames": GOOD[:2] + GOOD[GOOD.index(b"\xff\xc0") :][:13] + framed(9999, 9999)[2:],
    "far too long": GOOD[:-2] + bytes(64 * 64 * 4 + 4096) + GOOD[-2:],
}


PACKED = 64 * 64 // 8
MASKS = {
    "junk": b"junk",
    "cut": zlib.compress(bytes(PACKED))[:-3],
    "short": zlib.compress(bytes(PACKED - 1)),
    "long": zlib.compress(bytes(PACKED + 1)),
    "bomb": zlib.compress(bytes(20_000_000), 1),
    "more behind": zlib.compress(bytes(PACKED)) + b"more",
}


CHUNKS = [("", name) for name in JPEGS] + [("mask_", name) for name in MASKS]


@pytest.mark.parametrize(("kind", "name"), CHUNKS)
def test_a_chunk_that_is_no_grey_jpeg_of_its_size_or_has_no_mask_of_it(made, tmp_path, kind, name):
    info, parts = made
    blob = (MASKS if kind else JPEGS)[name]
    odd = write_layer(tmp_path / "odd.onav", info, with_chunk(parts, 2, kind, blob=blob))
    layer, said = GreyLayer.of(odd), kind.rstrip("_")
    with (
        memory_below(1e6),
        pytest.raises(MapFileError, match=rf"damaged \(level 0, chunk 0, 2: {said}.*odd.onav"),
    ):
        layer.read(0, 0, 130, 10, 10)
    assert layer.read(0, 0, 64, 20, 20)[0].any()  # the others can still be read


@settings(max_examples=200)
@given(data=st.data())
def test_whatever_is_done_to_a_chunk_only_our_errors_come_out(data):
    jpeg, mask = bytearray(GOOD), bytearray(zlib.compress(bytes(PACKED)))
    for blob in (jpeg, mask):
        for _ in range(data.draw(st.integers(0, 3))):
            place = data.draw(st.integers(0, len(blob)))
            blob[place : place + data.draw(st.integers(0, 9))] = data.draw(st.binary(max_size=9))
    blobs = (np.frombuffer(bytes(blob), dtype=np.uint8) for blob in (jpeg, mask))
    try:
        grey, valid = layer_module.decode_chunk(*blobs, (64, 64))
    except MapFileError:
        return
    assert grey.shape == (64, 64) and (valid is None or valid.shape == (64, 64))


def test_a_mask_without_a_picture(made, tmp_path):
    info, parts = made
    layer = GreyLayer.of(write_layer(tmp_path / "odd.onav", info, with_chunk(parts, 2, blob=b"")))
    assert not layer.read(0, 0, 130, 10, 10)[1].any()  # wholly valid, had no mask
    number = ChunkTable(*SHAPE, info.levels, CHUNK_PX).number(0, 0, 0)
    odd = write_layer(tmp_path / "odd.onav", info, with_chunk(parts, number, blob=b""))
    with pytest.raises(MapFileError, match="damaged"):
        GreyLayer.of(odd).read(0, 0, 0, 10, 10)
