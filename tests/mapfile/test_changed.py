"""A map that is changed in place while it is open: only what was opened is ever returned."""

import errno
import gc
import os
import re
from pathlib import Path

import numpy as np
import pytest
from maps import arrays, manifest

from orthonav.core.errors import MapChangedError, MapFileError
from orthonav.core.mapfile import GreyLayer, open_map, write_map
from orthonav.core.mapfile.layer import part_names
from orthonav.core.mapfile.reader import BLOCK_BYTES


@pytest.fixture
def path(tmp_path):
    write_map(tmp_path / "a.onav", manifest(), arrays())
    return tmp_path / "a.onav"


@pytest.fixture
def copy(map_path, tmp_path):
    """A copy of the map of the session, which has a registration layer."""
    made = tmp_path / "copy.onav"
    made.write_bytes(map_path.read_bytes())
    return made


def sizes(whole):
    """File sizes to truncate to: borders and places between them."""
    return [0, 1, 9, *range(100, whole, max(1, whole // 60)), whole - 1]


def rewritten(path, at, data):
    with path.open("r+b") as stream:
        stream.seek(at)
        stream.write(data)


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def whole_layer(layer, level=0):
    return layer.read(level, 0, 0, *layer.shape(level))


def test_a_file_of_any_size_is_refused_at_the_opening(path):
    content = path.read_bytes()
    for size in (*sizes(len(content)), *(len(content) - cut for cut in (2, 8, 64))):
        path.write_bytes(content[:size])
        with pytest.raises(MapFileError, match=re.escape(str(path))) as caught:
            open_map(path)
        assert "\n" not in str(caught.value)
    for more in (b"\0", b"\0" * 5000):
        path.write_bytes(content + more)
        with pytest.raises(MapFileError, match=f"{len(more)} bytes too many"):
            open_map(path)


def test_a_map_truncated_in_place_raises_at_every_size(path):
    content, right = path.read_bytes(), arrays()
    for size in sizes(len(content)):
        path.write_bytes(content)
        opened = open_map(path)
        os.truncate(path, size)
        for name, expected in right.items():
            try:
                found = opened.arrays[name]
            except MapChangedError as error:
                assert str(path) in str(error)
            else:
                assert found.tobytes() == expected.tobytes()
        assert str(size) in opened.change()
        with pytest.raises(MapChangedError):
            opened.arrays["tiles"]


def test_a_map_rewritten_in_place_never_returns_other_bytes(path):
    content, right = path.read_bytes(), arrays()
    start = 8 + int.from_bytes(content[:8], "little")
    for at in range(start, len(content), 97):
        path.write_bytes(content)
        opened = open_map(path)
        rewritten(path, at, bytes([content[at] ^ 1]))
        refused = 0
        for name, expected in right.items():
            try:
                assert opened.arrays[name].tobytes() == expected.tobytes()
            except MapChangedError:
                refused += 1
        assert refused > 0 and "rewritten" in opened.change()


def test_chunks_are_verified_when_they_are_read(copy):
    opened = open_map(copy)
    expected = whole_layer(GreyLayer.of(opened))
    part = opened.arrays.described(part_names(0)["bytes"])
    assert part.nbytes > BLOCK_BYTES  # more than one block is tested
    content = copy.read_bytes()
    for at in (0, part.nbytes // 2, part.nbytes - 1):
        copy.write_bytes(content)
        opened = open_map(copy)
        layer = GreyLayer.of(opened)
        rewritten(copy, part.first + at, bytes([content[part.first + at] ^ 0x10]))
        with pytest.raises(MapChangedError, match="rewritten"):
            for level in range(layer.levels):
                whole_layer(layer, level)
    copy.write_bytes(content)
    found = whole_layer(GreyLayer.of(open_map(copy)))
    assert all((one == other).all() for one, other in zip(found, expected, strict=True))


def test_a_truncated_layer_raises_or_is_what_was_opened(copy):
    size = copy.stat().st_size
    expected = whole_layer(GreyLayer.of(open_map(copy)))
    content = copy.read_bytes()
    for share in (0.0, 0.3, 0.6, 0.9):
        copy.write_bytes(content)
        layer = GreyLayer.of(open_map(copy), cache_bytes=0)
        os.truncate(copy, round(share * size))
        rows, cols = layer.shape(0)
        refused = False
        for row in range(0, rows, 64):
            try:
                grey, _ = layer.read(0, row, 0, 64, cols)
            except MapChangedError:
                refused = True
            else:
                # A map that failed once gives nothing more; chunks without imagery are not read.
                assert not refused or not expected[1][row : row + 64].any()
                assert (grey[: rows - row] == expected[0][row : row + 64]).all()
        assert refused


def test_a_removed_or_replaced_file_stays_open(path):
    opened = open_map(path)
    write_map(path, manifest(), arrays(seed=1))
    assert opened.change() is None
    path.unlink()
    assert opened.change() is None
    for name, expected in arrays().items():
        assert opened.arrays[name].tobytes() == expected.tobytes()


def test_an_error_of_the_medium_is_an_error_of_ours(path, monkeypatch):
    opened = open_map(path)

    def broken(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "pread", broken)
    with pytest.raises(MapChangedError, match="read error"):
        opened.arrays["tiles"]


def test_files_are_closed_with_their_maps(path):
    gc.collect()  # else files that other tests left are closed in between
    before = open_files()
    opened = [open_map(path) for _ in range(20)]
    assert open_files() == before + 20
    np.testing.assert_equal(opened[0].arrays["tiles"], arrays()["tiles"])
    opened.clear()
    assert open_files() == before
