"""Opening and writing a map; every byte is checked at the opening, and whenever it is read later.

The file is not memory-mapped: a mapping of a truncated file or a failing card ends the process
(SIGBUS). Parts are read with `pread` and compared with digests of the opening, so changes in flight
raise `MapChangedError`."""

import dataclasses
import errno
import hashlib
import json
import os
import re
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import save_file

from orthonav.core.errors import MapChangedError, MapFileError, MissingFileError, OutputError
from orthonav.core.files import StrPath, replacing, require_file
from orthonav.core.geo.frames import LocalFrame, wrapped_deg
from orthonav.core.mapfile.manifest import Manifest

METADATA_KEY = "orthonav"
BLOCK_BYTES = 16 * 2**10  # unit of verification of ranges, about one chunk (docs/map-format.md)
DIGEST_BYTES = 16  # of a block


@dataclass(frozen=True)
class _Part:
    """`sha256`: hexadecimal; `blocks`: digests concatenated, empty for parts read whole."""

    dtype: type[np.generic]
    shape: tuple[int, ...]
    first: int
    nbytes: int
    sha256: str
    blocks: bytes = b""


class MapParts(Mapping[str, NDArray[Any]]):
    """The parts of an open map by name, read when asked for; raises `MapChangedError`."""

    def __init__(self, path: Path, opened: "_OpenFile", parts: dict[str, _Part]) -> None:
        self._path, self._file, self._parts = path, opened, parts
        self._change: str | None = None

    def __getitem__(self, name: str) -> NDArray[Any]:
        part = self._parts[name]
        data = self._read(part.first, part.nbytes)
        if hashlib.sha256(data).hexdigest() != part.sha256:
            raise self._changed(f"part {name} was rewritten")
        return np.frombuffer(data, dtype=part.dtype).reshape(part.shape)

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)

    def described(self, name: str) -> _Part | None:
        """None if there is no such part."""
        return self._parts.get(name)

    def range(self, name: str, first: int, last: int) -> bytes:
        """`first` to `last` (excluded)."""
        if first >= last:
            return b""
        part = self._parts[name]
        begin = first // BLOCK_BYTES
        end = -(-last // BLOCK_BYTES)
        start = begin * BLOCK_BYTES
        data = self._read(part.first + start, min(end * BLOCK_BYTES, part.nbytes) - start)
        if _block_digests(data) != part.blocks[begin * DIGEST_BYTES : end * DIGEST_BYTES]:
            raise self._changed(f"part {name} was rewritten")
        return data[first - start : last - start]

    def change(self) -> str | None:
        """How the open file differs from the one that was opened; None as far as is known.

        The size is compared now. Other changes are known once they were read, and remain."""
        if self._change is None:
            size = self._file.size_now()
            if size != self._file.size:
                self._change = f"{size} bytes instead of {self._file.size}"
        return self._change

    def _read(self, first: int, length: int) -> bytes:
        if self._change is not None:
            raise self._changed(self._change)
        try:
            data = self._file.read(first, length)
        except OSError as error:
            raise self._changed(f"read error: {error.strerror}") from error
        if len(data) != length:
            raise self._changed(self.change() or "it was truncated")
        return data

    def _changed(self, how: str) -> MapChangedError:
        self._change = self._change or how
        return MapChangedError(
            f"map file changed since it was opened ({how}); write maps to a new file and rename "
            f"it: {self._path}"
        )


@dataclass(frozen=True, eq=False)
class MapFile:
    """An opened map, or one that was built and not yet written.

    `arrays`: its parts by name, read-only; those of an opened map are read when asked for. Frame,
    resolution, coordinate system, bounds and `contains` are those of its first sheet."""

    path: Path
    size_bytes: int
    manifest: Manifest
    arrays: Mapping[str, NDArray[Any]]

    def __repr__(self) -> str:
        return f"MapFile({self.path}, {self.manifest.area_km2:.2f} km2, {self.gsd_m:g} m per pixel)"

    @property
    def frame(self) -> LocalFrame:
        """Its `en_from_latlon(lat_deg, lon_deg)` gives metres east and north of the centre."""
        return self.manifest.sheets[0].frame

    @property
    def gsd_m(self) -> float:
        """Metres on the ground per pixel."""
        return self.manifest.sheets[0].grid.gsd_m

    @property
    def crs(self) -> str:
        """The coordinate system of `frame`, for PROJ."""
        return self.frame.proj4

    @property
    def dates(self) -> tuple[str, ...]:
        """Dates of its imagery as ISO 8601, as far as they are known, in order."""
        sources = self.manifest.imagery
        found = {str(x[end]) for x in sources for end in ("date_from", "date") if x.get(end)}
        return tuple(sorted(found))

    @property
    def bounds_deg(self) -> tuple[float, float, float, float]:
        """West, south, east and north of the first sheet, degrees; across the antimeridian west is
        greater than east."""
        west_m, south_m, east_m, north_m = self.manifest.sheets[0].grid.extent_en_m
        # Parallels are curved: on the meridian of the centre a side may lie farthest out.
        across_m = west_m, min(max(west_m, 0.0), east_m), east_m
        lat, lon = self.frame.latlon_from_en([(x, y) for x in across_m for y in (south_m, north_m)])
        off = wrapped_deg(lon - self.frame.lon_deg)
        ends = self.frame.lon_deg + np.array([off.min(), off.max()])
        west, east = wrapped_deg(ends).tolist()
        return west, float(lat.min()), east, float(lat.max())

    def contains(self, lat_deg: float, lon_deg: float) -> bool:
        """Whether a position is on the first sheet."""
        x_m, y_m = self.frame.en_from_latlon(lat_deg, lon_deg).tolist()
        west_m, south_m, east_m, north_m = self.manifest.sheets[0].grid.extent_en_m
        return bool(west_m <= x_m <= east_m and south_m <= y_m <= north_m)

    def array(self, name: str, dtype: type[np.generic], ndim: int) -> NDArray[Any]:
        """The part `name`; raises `MapFileError` if it is missing or has another type or shape."""
        self.size_of(name, dtype, ndim)
        return self.arrays[name]

    def size_of(self, name: str, dtype: type[np.generic], ndim: int) -> int:
        """Bytes of the part `name`, without reading it; raises as `array`."""
        arrays = self.arrays
        found: _Part | NDArray[Any] | None
        found = arrays.described(name) if isinstance(arrays, MapParts) else arrays.get(name)
        if found is None or found.dtype != dtype or len(found.shape) != ndim:
            got = "nothing"
            if found is not None:
                got = f"{np.dtype(found.dtype)} of {len(found.shape)} dimensions"
            raise MapFileError(
                f"map part {name} must be {np.dtype(dtype)} of {ndim} dimensions, got {got}: "
                f"{self.path}"
            )
        return found.nbytes

    def range(self, name: str, first: int, last: int) -> bytes:
        """Bytes `first` to `last` (excluded) of a part that is read in ranges.

        Raises `MapChangedError` if they are not those of the opening."""
        if isinstance(self.arrays, MapParts):
            return self.arrays.range(name, first, last)
        return self.arrays[name][first:last].tobytes()

    def change(self) -> str | None:
        """How the open file was changed in place, as far as is known; see `MapParts.change`."""
        return self.arrays.change() if isinstance(self.arrays, MapParts) else None


class Blobs:
    """Byte strings concatenated in one part of a map, with their offsets in another."""

    def __init__(self, opened: MapFile, data: str, offsets: str, count: int) -> None:
        """Raises `MapFileError` where the offsets do not fit."""
        size = opened.size_of(data, np.uint8, 1)
        self._opened, self._name = opened, data
        self._offsets: NDArray[Any] = opened.array(offsets, np.int64, 1)
        places = self._offsets
        sane = (
            len(places) == count + 1
            and places[0] == 0
            and places[-1] == size
            and bool((places[1:] >= places[:-1]).all())
        )
        if not sane:
            raise MapFileError(
                f"map part {offsets} must rise from 0 to {size} in {count + 1} numbers: "
                f"{opened.path}"
            )

    def is_empty(self, number: int) -> bool:
        return bool(self._offsets[number] == self._offsets[number + 1])

    def blob(self, number: int) -> NDArray[np.uint8]:
        """Raises `MapChangedError`."""
        first, last = int(self._offsets[number]), int(self._offsets[number + 1])
        return np.frombuffer(self._opened.range(self._name, first, last), dtype=np.uint8)


def blob_parts(data: str, offsets: str, blobs: Sequence[bytes]) -> dict[str, NDArray[Any]]:
    """Two parts of a map from which `Blobs` reads these byte strings."""
    ends = np.cumsum([0, *map(len, blobs)], dtype=np.int64)
    return {data: np.frombuffer(b"".join(blobs), np.uint8), offsets: ends}


class _OpenFile:
    """Closed when the object is collected."""

    def __init__(self, path: Path) -> None:
        self._number = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        weakref.finalize(self, os.close, self._number)
        self.size = self.size_now()

    def size_now(self) -> int:
        return os.fstat(self._number).st_size

    def read(self, first: int, length: int) -> bytes:
        """Fewer bytes where the file ends. Raises `OSError`."""
        data = os.pread(self._number, length, first)
        if len(data) in (0, length):
            return data
        pieces, count = [data], len(data)
        while count < length and data:  # the system returns at most 2 GiB at once
            data = os.pread(self._number, length - count, first + count)
            pieces.append(data)
            count += len(data)
        return b"".join(pieces)


def open_map(path: StrPath, manifest_sha256: str | None = None) -> MapFile:
    """Open a map and verify every checksum in it.

    `manifest_sha256`: of a signature; another map is refused, also one swapped after its check.
    Raises `MissingFileError`, `MapFileError`, or `MapVersionError`.

    The container is safetensors, parsed here because arrays are read on demand and every length is
    checked before it is used."""
    path = require_file(path, "map")
    with _errors_named(path):
        opened, start, header, manifest = _opened(path)
        if manifest_sha256 not in (None, manifest.sha256):
            raise MapFileError("map was replaced after its signature was checked; try again")
        parts = _parts(opened, start, header, manifest)
    return MapFile(path, opened.size, manifest, MapParts(path, opened, parts))


def map_digest(path: StrPath) -> str:
    """SHA-256 of the manifest of a map, hexadecimal, by its header only. Raises as `open_map`."""
    path = require_file(path, "map")
    with _errors_named(path):
        return _opened(path)[3].sha256


@contextmanager
def _errors_named(path: Path) -> Iterator[None]:
    try:
        yield
    except MapFileError as error:
        raise type(error)(f"{error}: {path}") from error
    except OSError as error:
        raise MissingFileError(f"map cannot be read ({error.strerror}): {path}") from error
    except (OverflowError, RecursionError) as error:  # crafted: excessive numbers or nesting
        raise MapFileError(f"map is damaged ({error}): {path}") from error


def _opened(path: Path) -> tuple[_OpenFile, int, dict[str, Any], Manifest]:
    """The file, where its arrays begin, their entries in the header, and the manifest."""
    opened = _OpenFile(path)
    if opened.size < 10:
        raise MapFileError(f"not an orthonav map, only {opened.size} bytes")
    header, start = _header(opened)
    metadata = header.pop("__metadata__", None)
    if not isinstance(metadata, dict) or not isinstance(metadata.get(METADATA_KEY), str):
        raise MapFileError("not an orthonav map")
    return opened, start, header, Manifest.from_json(metadata[METADATA_KEY])


def _header(opened: _OpenFile) -> tuple[dict[str, Any], int]:
    head = opened.read(0, 9)
    length = int.from_bytes(head[:8], "little")
    if length > 16 * 2**20 or head[8:] != b"{":
        raise MapFileError("not an orthonav map; `orthonav build` makes one from orthophotos")
    data = opened.read(8, length)
    if len(data) != length:
        raise MapFileError("map is truncated (header)")
    try:
        header = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise MapFileError("map is damaged (header is not JSON)") from error
    if not isinstance(header, dict):
        raise MapFileError("map is damaged (header)")
    return header, 8 + length


def _parts(
    opened: _OpenFile, start: int, header: dict[str, Any], manifest: Manifest
) -> dict[str, _Part]:
    if set(header) != set(manifest.parts):
        raise MapFileError("map was altered (its parts differ from the manifest)")
    parts: dict[str, _Part] = {}
    size, covered = opened.size, start
    for name, entry in sorted(header.items(), key=lambda item: _offsets(item[1])):
        first, last = _offsets(entry)
        if start + first != covered:
            raise MapFileError(f"map is damaged (part {name} has a wrong offset)")
        if start + last > size:
            raise MapFileError(f"map is truncated ({size} of {start + last} bytes or more)")
        parts[name] = _part(opened, start + first, last - first, name, entry, manifest)
        covered = start + last
    if covered != size:
        raise MapFileError(f"map was altered ({size - covered} bytes too many)")
    return parts


def _offsets(entry: Any) -> tuple[int, int]:
    offsets = entry.get("data_offsets") if isinstance(entry, dict) else None
    if not _is_integers(offsets) or len(offsets) != 2 or not 0 <= offsets[0] <= offsets[1]:
        raise MapFileError("map is damaged (header)")
    return offsets[0], offsets[1]


def _is_integers(value: Any) -> TypeGuard[list[int]]:
    return isinstance(value, list) and all(type(item) is int for item in value)


def _part(
    opened: _OpenFile, first: int, length: int, name: str, entry: dict[str, Any], manifest: Manifest
) -> _Part:
    described = manifest.parts[name]
    dtypes: dict[str, type[np.generic]] = {
        "F16": np.float16,
        "F32": np.float32,
        "U8": np.uint8,
        "I32": np.int32,
        "I64": np.int64,
    }
    dtype = dtypes.get(str(entry.get("dtype")))
    shape: Any = entry.get("shape")
    if dtype is None or not _is_integers(shape):
        raise MapFileError(f"map is damaged (part {name})")
    count = 1
    for extent in shape:
        count *= extent
    same = isinstance(described, dict) and described.get("dtype") == np.dtype(dtype).name
    same = same and described.get("shape") == shape
    if not same or min(shape, default=0) < 0 or count * np.dtype(dtype).itemsize != length:
        raise MapFileError(f"map was altered (part {name} differs from the manifest)")
    try:
        np.broadcast_to(np.zeros((), dtype=dtype), shape)
    except ValueError as error:  # an empty part can claim any shape
        raise MapFileError(f"map is damaged (part {name}: {error})") from error
    # The largest parts of a map are read in ranges.
    is_in_ranges = re.fullmatch(r"sheet\d+/(grey/(mask_)?|(terrain|surface)/)bytes", name)
    digest, blocks = _digests(opened, first, length, blocks=is_in_ranges is not None)
    if digest != described.get("sha256"):
        raise MapFileError(f"map was altered (checksum of part {name} does not match)")
    return _Part(dtype, tuple(shape), first, length, digest, blocks)


def _digests(opened: _OpenFile, first: int, length: int, *, blocks: bool) -> tuple[str, bytes]:
    """SHA-256 (hexadecimal), and digests of the blocks where asked for."""
    whole, of_blocks = hashlib.sha256(), bytearray()
    step = 64 * BLOCK_BYTES
    for at in range(first, first + length, step):
        piece = opened.read(at, min(step, first + length - at))
        whole.update(piece)
        if blocks:
            of_blocks += _block_digests(piece)
    return whole.hexdigest(), bytes(of_blocks)


def _block_digests(data: bytes) -> bytes:
    """Concatenated; BLAKE2b is fast without SHA instructions."""
    view = memoryview(data)
    return b"".join(
        hashlib.blake2b(view[at : at + BLOCK_BYTES], digest_size=DIGEST_BYTES).digest()
        for at in range(0, len(data), BLOCK_BYTES)
    )


def write_map(path: Path, manifest: Manifest, arrays: Mapping[str, NDArray[Any]]) -> Manifest:
    """The manifest with its `parts` filled in. Raises `OutputError` and leaves nothing behind."""
    parts = {name: np.ascontiguousarray(array) for name, array in sorted(arrays.items())}
    described = {
        name: {
            "dtype": str(array.dtype),
            "shape": list(array.shape),
            "sha256": hashlib.sha256(array.data).hexdigest(),
        }
        for name, array in parts.items()
    }
    full = dataclasses.replace(manifest, parts=described)
    save_tensors(path, parts, full.to_json(), "map")
    return full


def save_tensors(path: Path, arrays: Mapping[str, NDArray[Any]], metadata: str, what: str) -> None:
    """Complete or not at all; raises `OutputError`, which names `what`."""
    with replacing(path) as temporary:
        try:
            contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
            save_file(contiguous, temporary, metadata={METADATA_KEY: metadata})
        except SafetensorError as error:
            if f"os error {errno.ENOSPC}" in str(error):
                raise OSError(errno.ENOSPC, "disk full") from error
            raise OutputError(f"{what} cannot be written ({error}): {path}") from error
