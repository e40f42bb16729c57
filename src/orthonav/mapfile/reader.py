"""Opening a map: memory-mapped, and fully checked before any of it is used."""

import hashlib
import json
import mmap
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import MapFileError, MissingFileError
from orthonav.files import require_file
from orthonav.mapfile.manifest import Manifest
from orthonav.mapfile.writer import METADATA_KEY

MAX_HEADER_BYTES = 16 * 2**20
MIN_FILE_BYTES = 10
_DTYPES = {
    "F16": np.float16,
    "F32": np.float32,
    "U8": np.uint8,
    "I32": np.int32,
    "I64": np.int64,
}


@dataclass(frozen=True, eq=False)
class MapFile:
    """An opened map. `arrays` are read-only views into the mapped file."""

    path: Path
    size_bytes: int
    manifest: Manifest
    arrays: dict[str, NDArray[Any]]

    def array(self, name: str, dtype: type[np.generic], ndim: int) -> NDArray[Any]:
        """The part `name`; raises `MapFileError` if it is missing or has another type or shape."""
        found = self.arrays.get(name)
        if found is None or found.dtype != dtype or found.ndim != ndim:
            got = "nothing" if found is None else f"{found.dtype} of {found.ndim} dimensions"
            raise MapFileError(
                f"map part {name} must be {np.dtype(dtype)} of {ndim} dimensions, got {got}: "
                f"{self.path}"
            )
        return found


def open_map(path: Path) -> MapFile:
    """Open a map and verify every checksum in it.

    The container is safetensors: eight bytes with the length of a JSON header, the header, raw
    arrays. It is parsed here, not with the library, because the arrays are mapped instead of
    copied, and because every length is checked against the file before it is used.
    Raises `MissingFileError`, `MapFileError`, or `MapVersionError`.
    """
    path = require_file(path, "map")
    mapped = _mapped(path)
    size = len(mapped)
    try:
        header, start = _header(mapped, size)
        metadata = header.pop("__metadata__", None)
        if not isinstance(metadata, dict) or not isinstance(metadata.get(METADATA_KEY), str):
            raise MapFileError("not an orthonav map")
        manifest = Manifest.from_json(metadata[METADATA_KEY])
        arrays = _arrays(mapped, size, start, header, manifest)
    except MapFileError as error:
        raise type(error)(f"{error}: {path}") from error
    except (OverflowError, RecursionError) as error:  # crafted: excessive numbers or nesting
        raise MapFileError(f"map is damaged ({error}): {path}") from error
    return MapFile(path, size, manifest, arrays)


def _mapped(path: Path) -> mmap.mmap:
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size < MIN_FILE_BYTES:
                raise MapFileError(f"not an orthonav map, only {size} bytes: {path}")
            return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise MissingFileError(f"map cannot be read ({error.strerror}): {path}") from error


def _header(mapped: mmap.mmap, size: int) -> tuple[dict[str, Any], int]:
    length = int.from_bytes(mapped[:8], "little")
    if length > MAX_HEADER_BYTES or mapped[8:9] != b"{":
        raise MapFileError("not an orthonav map")
    if 8 + length > size:
        raise MapFileError("map is truncated (header)")
    try:
        header = json.loads(mapped[8 : 8 + length].decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise MapFileError("map is damaged (header is not JSON)") from error
    if not isinstance(header, dict):
        raise MapFileError("map is damaged (header)")
    return header, 8 + length


def _arrays(
    mapped: mmap.mmap, size: int, start: int, header: dict[str, Any], manifest: Manifest
) -> dict[str, NDArray[Any]]:
    if set(header) != set(manifest.parts):
        raise MapFileError("map was altered (its parts differ from the manifest)")
    arrays: dict[str, NDArray[Any]] = {}
    covered = start
    for name, entry in sorted(header.items(), key=lambda item: _offsets(item[1])):
        first, last = _offsets(entry)
        if start + first != covered:
            raise MapFileError(f"map is damaged (part {name} has a wrong offset)")
        if start + last > size:
            raise MapFileError(f"map is truncated ({size} of {start + last} bytes or more)")
        arrays[name] = _array(mapped, start + first, last - first, name, entry, manifest)
        covered = start + last
    if covered != size:
        raise MapFileError(f"map was altered ({size - covered} bytes too many)")
    return arrays


def _offsets(entry: Any) -> tuple[int, int]:
    offsets = entry.get("data_offsets") if isinstance(entry, dict) else None
    if not _is_integers(offsets) or len(offsets) != 2 or not 0 <= offsets[0] <= offsets[1]:
        raise MapFileError("map is damaged (header)")
    return offsets[0], offsets[1]


def _is_integers(value: Any) -> TypeGuard[list[int]]:
    return isinstance(value, list) and all(type(item) is int for item in value)


def _array(
    mapped: mmap.mmap, first: int, length: int, name: str, entry: dict[str, Any], manifest: Manifest
) -> NDArray[Any]:
    described = manifest.parts[name]
    dtype = _DTYPES.get(str(entry.get("dtype")))
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
    view = memoryview(mapped)[first : first + length]
    if hashlib.sha256(view).hexdigest() != described.get("sha256"):
        raise MapFileError(f"map was altered (checksum of part {name} does not match)")
    try:
        return np.frombuffer(view, dtype=dtype).reshape(shape)
    except ValueError as error:  # an empty part can claim any shape
        raise MapFileError(f"map is damaged (part {name}: {error})") from error
