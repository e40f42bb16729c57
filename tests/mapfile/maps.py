"""A small map, and containers written byte by byte, as untrusted files may be."""

import hashlib
import json

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.grid import TileGrid
from orthonav.core.mapfile import Manifest, SheetInfo

GRID = TileGrid(-100.0, 90.0, 1.0, 64, 32, 3, 4)


def manifest():
    """The manifest of a map of twelve tiles, before its parts are known."""
    return Manifest(
        recipe={"method": "gradient", "represent": {"name": "gradient", "sigma_px": 1.2}},
        sheets=(SheetInfo(LocalFrame(46.5, 2.5), GRID, 12, 0.0123),),
        imagery=({"name": "été.tif", "date": "2021-06", "gsd_m": 0.2},),
        view={"heading_step_deg": 6.0, "min_valid_share": 0.1, "position_std_m": 7.25},
        confidence={"weights": [1.5, -2e-05], "bias": 0.5},
        radius_m=24.0,
        created_by="orthonav test",
    )


def arrays(seed=0):
    """One part of every kind that a map may hold, an empty one included."""
    rng = np.random.default_rng(seed)
    return {
        "sheet0/centres_en_m": rng.normal(size=(12, 2)).astype(np.float32),
        "sheet0/embeddings": rng.normal(size=(12, 16)).astype(np.float16),
        "sheet0/preview_jpeg": rng.integers(0, 256, 301).astype(np.uint8),
        "tiles": np.arange(7, dtype=np.int32),
        "none": np.zeros((0, 3), dtype=np.float32),
    }


def taken_apart(path):
    """Header (dict), manifest (dict) and data (bytes) of a map file."""
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    return header, json.loads(header["__metadata__"]["orthonav"]), content[8 + length :]


def put_together(path, header, plain=None, data=b"", *, sign=True):
    """Write a container; `plain` (dict, or text as it stands) becomes the manifest, signed."""
    if isinstance(plain, dict):
        plain = {key: value for key, value in plain.items() if key != "manifest_sha256"}
        text = json.dumps(plain, sort_keys=True, separators=(",", ":"))
        digest = hashlib.sha256(text.encode()).hexdigest()
        plain = json.dumps({**plain, "manifest_sha256": digest} if sign else plain)
    if plain is not None:
        header = {**header, "__metadata__": {"orthonav": plain}}
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)
    return path


def altered(path, **changes):
    """The map with other entries of its manifest, signed anew."""
    header, plain, data = taken_apart(path)
    return put_together(path, header, {**plain, **changes}, data)


def altered_sheet(path, **changes):
    """The same of its sheet."""
    return altered(path, sheets=[{**taken_apart(path)[1]["sheets"][0], **changes}])


def described(array, first=0):
    """A part as the header and as the manifest describe it, and its bytes."""
    names = {"float16": "F16", "float32": "F32", "uint8": "U8", "int32": "I32"}
    data = array.tobytes()
    entry = {
        "dtype": names[str(array.dtype)],
        "shape": list(array.shape),
        "data_offsets": [first, first + len(data)],
    }
    digest = hashlib.sha256(data).hexdigest()
    part = {"dtype": str(array.dtype), "shape": list(array.shape), "sha256": digest}
    return entry, part, data
