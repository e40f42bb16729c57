"""A map comes back as it was written, or not at all."""

import errno
import hashlib
import os
import sys
from dataclasses import replace

import numpy as np
import pytest
import safetensors
import safetensors.numpy
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import (
    GRID,
    altered,
    altered_sheet,
    arrays,
    described,
    manifest,
    put_together,
    taken_apart,
)

from helpers import memory_below
from orthonav.core.errors import MapFileError, MapVersionError, MissingFileError, OutputError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.mapfile import MapFile, SheetInfo, open_map, write_map


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """The bytes of a map."""
    path = tmp_path_factory.mktemp("map") / "area.onav"
    write_map(path, manifest(), arrays())
    return path.read_bytes()


@pytest.fixture
def path(tmp_path, content):
    """A whole map file."""
    path = tmp_path / "area.onav"
    path.write_bytes(content)
    return path


def same_as_written(opened):
    """Whether all that can be read is what was written."""
    found = opened.manifest
    wanted = {**vars(manifest()), "parts": found.parts, "sha256": found.sha256}
    same = vars(found) == wanted and sorted(opened.arrays) == sorted(arrays())
    return same and all(
        opened.arrays[name].dtype == array.dtype and np.array_equal(opened.arrays[name], array)
        for name, array in arrays().items()
    )


def refused(path, message=None, error=MapFileError):
    with pytest.raises(error, match=message) as caught:
        open_map(path)
    assert str(caught.value).endswith(str(path))


def test_round_trip(path, content):
    opened = open_map(path)
    assert same_as_written(opened)
    assert opened.size_bytes == len(content) and opened.path == path
    again = path.with_name("again.onav")
    assert write_map(again, opened.manifest, opened.arrays) == opened.manifest
    assert again.read_bytes() == content


@pytest.mark.parametrize("lat_deg, lon_deg", [(-17.0, 179.9999), (70.0, 20.0), (-60.0, -180.0)])
def test_bounds_hold_the_sheet_also_across_the_antimeridian(path, lat_deg, lon_deg):
    grid = replace(GRID, west_m=-20_000.0, north_m=20_000.0, gsd_m=200.0)
    sheet = SheetInfo(LocalFrame(lat_deg, lon_deg), grid, 12, 0.0123)
    map_ = MapFile(path, 1, replace(manifest(), sheets=(sheet,)), {})
    west, south, east, north = map_.bounds_deg
    west_m, south_m, east_m, north_m = grid.extent_en_m
    x, y = np.meshgrid(np.linspace(west_m, east_m, 101), np.linspace(south_m, north_m, 101))
    lat, lon = map_.frame.latlon_from_en(np.stack([x, y], axis=-1))
    assert (lat.min(), lat.max()) == pytest.approx((south, north), abs=2e-6)
    across = (east - west) % 360
    assert ((lon - west + 1) % 360 - 1).max() == pytest.approx(across, abs=1e-9) and across < 2


def test_arrays_are_read_only(path):
    for name, array in open_map(path).arrays.items():
        assert not array.flags.writeable, name
        with pytest.raises(ValueError):
            array.flags.writeable = True


def test_a_part_of_another_kind_is_refused(path):
    opened = open_map(path)
    assert (opened.array("tiles", np.int32, 1) == arrays()["tiles"]).all()
    for name, dtype, ndim in (("tiles", np.uint8, 1), ("tiles", np.int32, 2), ("no", np.int32, 1)):
        with pytest.raises(MapFileError, match=f"map part {name} must be"):
            opened.array(name, dtype, ndim)


def test_the_safetensors_library_reads_the_same(path):
    opened = open_map(path)
    with safetensors.safe_open(path, framework="numpy") as other:
        assert sorted(other.keys()) == sorted(opened.arrays)
        for name, array in opened.arrays.items():
            np.testing.assert_array_equal(other.get_tensor(name), array)
        assert other.metadata()["orthonav"].startswith("{")


def test_no_flipped_bit_goes_unnoticed(path, content):
    """Its length stays, so that only checksums show it."""
    rng = np.random.default_rng(0)
    header_end = 8 + int.from_bytes(content[:8], "little")
    places = [*rng.integers(0, len(content), 100), *rng.integers(0, header_end, 100), *range(10)]
    for place in map(int, places):
        flipped = bytearray(content)
        flipped[place] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        try:
            opened = open_map(path)
        except MapFileError:
            continue
        assert same_as_written(opened), f"byte {place}"  # such as 1e-05 become 1E-05


@settings(max_examples=100)
@given(data=st.data())
def test_whatever_is_done_to_a_map_only_our_errors_come_out(tmp_path_factory, content, data):
    path = tmp_path_factory.getbasetemp() / "mutated.onav"
    mutated = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(mutated)))
        end = place + data.draw(st.integers(0, 40))
        mutated[place:end] = data.draw(
            st.one_of(
                st.binary(max_size=40),
                st.sampled_from(
                    [b"[" * 99, b"{", b'"', b"9" * 30, b"-1", b"NaN", b"null", b"1e999"]
                ),
            )
        )
    path.write_bytes(mutated)
    try:
        opened = open_map(path)
    except MapFileError:
        return
    assert bytes(mutated) == content or same_as_written(opened)


@pytest.mark.parametrize(
    "junk",
    [
        b"",
        b"{",
        bytes(9),
        bytes(4096),
        b"\xff" * 4096,
        b"PK\x03\x04" + bytes(100),
        (2).to_bytes(8, "little") + b"{}",
        (4).to_bytes(8, "little") + b"null",
        (2).to_bytes(8, "little") + b"[]",
        (4).to_bytes(8, "little") + b'{"\xff"',
        (17 * 2**20).to_bytes(8, "little") + b"{" + bytes(100),
        (2**64 - 1).to_bytes(8, "little") + b"{" + bytes(100),
        (100_000).to_bytes(8, "little") + b'{"a":' + b"[" * 99_995,
        np.random.default_rng(0).bytes(5000),
    ],
    ids=range(14),
)
def test_a_file_that_is_no_map(path, junk):
    path.write_bytes(junk)
    refused(path)


def test_a_file_that_is_missing_a_folder_or_not_ours(tmp_path):
    refused(tmp_path / "none.onav", "does not exist", MissingFileError)
    refused(tmp_path, "is a folder", MissingFileError)
    for metadata in (None, {"format": "pt"}, {"orthonav": "{}"}, {"orthonav": "no JSON"}):
        safetensors.numpy.save_file(arrays(), tmp_path / "model.safetensors", metadata)
        refused(tmp_path / "model.safetensors", "not an orthonav map|not JSON")


def test_a_file_that_may_not_be_read(path, monkeypatch):
    def refuse(*args, **kwargs):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    refused(path, "cannot be read", MissingFileError)


def test_a_newer_schema_is_named(path):
    altered(path, schema=2, sheets="of another kind")
    refused(path, r"has schema 2, this program reads up to 1; update", MapVersionError)


WRONG = {
    "schema": (0, -1, 1.0, True, "1", None),
    "sheets": ([], [5], {}),
    "recipe": ([],),
    "imagery": (None,),
    "view": (5, {"heading_step_deg": 10**400}),
    "radius_m": ("24", True, 10**400),
    "parts": ([], {}),
    "format": ("other",),
}
WRONG_SHEET = {
    "origin_lat_deg": (90.5, None),
    "origin_lon_deg": (1e9,),
    "tiles": (13, 0, 1.5),
    "area_km2": ("1",),
}
WRONG_GRID = {
    "gsd_m": (0, 1e300),
    "tile_px": (8, 10**6),
    "stride_px": (0, 65),
    "rows": (0, True),
    "cols": (10**9, 10**400),
    "west_m": (-(10**400),),
    "north_m": ([],),
}


def each_of(wrong):
    cases = [(name, value) for name, values in wrong.items() for value in values]
    return pytest.mark.parametrize("name, value", cases, ids=lambda each: str(each)[:30])


@each_of(WRONG)
def test_a_signed_manifest_of_nonsense(path, name, value):
    refused(altered(path, **{name: value}))


@each_of(WRONG_SHEET)
def test_a_signed_sheet_of_nonsense(path, name, value):
    refused(altered_sheet(path, **{name: value}))


@each_of(WRONG_GRID)
def test_a_signed_grid_of_nonsense(path, name, value):
    grid = taken_apart(path)[1]["sheets"][0]["grid"]
    refused(altered_sheet(path, grid={**grid, name: value}))


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_numbers_that_are_none(path, number):
    header, _, data = taken_apart(path)
    stated = header["__metadata__"]["orthonav"].replace('"radius_m":24.0', f'"radius_m":{number}')
    assert number in stated
    refused(put_together(path, header, stated, data))
    refused(put_together(path, header, f'{{"format":"orthonav-map","schema":{number}}}', data))


def test_nesting_however_deep(path):
    header, _, data = taken_apart(path)
    depths = [*range(sys.getrecursionlimit() - 250, sys.getrecursionlimit() + 5, 3), 10**5]
    for depth in depths:
        nested = "[" * depth + "]" * depth
        text = f'{{"format":"orthonav-map","recipe":{nested},"schema":1}}'
        digest = hashlib.sha256(text.encode()).hexdigest()
        signed = f'{text[:-1]},"manifest_sha256":"{digest}"}}'
        refused(put_together(path, header, signed, data))


def with_part(path, name, entry, part, more=b""):
    """The map with the given part and its bytes after the others."""
    header, plain, data = taken_apart(path)
    header[name], plain["parts"][name] = entry, part
    return put_together(path, header, plain, data + more)


def test_an_additional_or_missing_part_is_refused(path):
    header, plain, data = taken_apart(path)
    entry, _, more = described(np.arange(5, dtype=np.int32), len(data))
    refused(put_together(path, {**header, "extra": entry}, plain, data + more), "its parts differ")
    del header["tiles"]
    refused(put_together(path, header, plain, data), "its parts differ")
    del plain["parts"]["tiles"]
    refused(put_together(path, header, plain, data), "has a wrong offset|too many")


@pytest.mark.parametrize(
    "shape",
    [
        *([6], [8], [7, 1], [1, 7], [-7], [-1, -7], [7.0], [True, 7]),
        *("7", 7, None, [], [2**62], [2**64]),
    ],
    ids=lambda shape: str(shape)[:50],
)
def test_wrong_shapes(path, shape):
    header, plain, data = taken_apart(path)
    header["tiles"]["shape"] = shape
    refused(put_together(path, header, plain, data))
    if shape not in ([7, 1], [1, 7]):  # the same bytes in another shape are no damage
        plain["parts"]["tiles"]["shape"] = shape
        refused(put_together(path, header, plain, data))


@pytest.mark.parametrize("shape", [[0, 2**65], [0, 10**30], [2**40, 0, 2**40], [0] * 100, [1] * 65])
def test_shapes_that_numpy_cannot_hold(path, shape):
    array = np.zeros(1 if shape[0] == 1 else 0, dtype=np.uint8)
    entry, part, more = described(array, len(taken_apart(path)[2]))
    entry["shape"] = part["shape"] = shape
    refused(with_part(path, "odd", entry, part, more))


def test_wrong_offsets_are_refused(path):
    header, plain, data = taken_apart(path)
    first, last = header["tiles"]["data_offsets"]
    for offsets in (
        [first - 4, last - 4],
        [first + 4, last + 4],
        [0, last - first],
        [first, last - 4],
        [last, first],
        [-last, -first],
        [first, last + 2**40],
        [first + 2**64, last + 2**64],
        [float(first), last],
        [first],
        [first, last, last],
        None,
        {},
    ):
        moved = {**header, "tiles": {**header["tiles"], "data_offsets": offsets}}
        refused(put_together(path, moved, plain, data))
    for entry in (None, [], 5, {}):
        refused(put_together(path, {**header, "tiles": entry}, plain, data))
        stated = {**plain, "parts": {**plain["parts"], "tiles": entry}}
        refused(put_together(path, header, stated, data))


def test_huge_shapes_take_no_memory(path):
    huge = {"dtype": "F32", "shape": [2**31, 2**10], "data_offsets": [0, 2**43]}
    part = {"dtype": "float32", "shape": [2**31, 2**10], "sha256": "0" * 64}
    _, plain, data = taken_apart(path)
    put_together(path, {"huge": huge}, {**plain, "parts": {"huge": part}}, data)
    with memory_below(5e6):
        refused(path, "truncated")


@pytest.mark.parametrize("fails", ["orthonav.core.mapfile.reader.save_file", "os.fsync"])
@pytest.mark.parametrize("old", [True, False])
def test_a_full_disk_keeps_the_old_map(path, content, monkeypatch, fails, old):
    if not old:
        path.unlink()

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(fails, full)
    with pytest.raises(OutputError, match="disk full"):
        write_map(path, manifest(), arrays(seed=1))
    assert list(path.parent.iterdir()) == ([path] if old else [])
    assert not old or path.read_bytes() == content


@pytest.mark.parametrize("dtype", ["F64", "I64", "U16", "BOOL", "f16", "", None, 5, ["F16"]])
def test_wrong_types(path, dtype):
    header, plain, data = taken_apart(path)
    header["sheet0/embeddings"]["dtype"] = dtype
    refused(put_together(path, header, plain, data))
