"""Cache of Segment Anything boundaries: one file per window, a digest and then compressed bits.

Entries are written atomically; a damaged entry is computed again.
"""

import hashlib
import logging
import os
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import OutputError
from orthonav.core.files import replacing

_DIGEST_BYTES = 32

log = logging.getLogger(__name__)

Mask = NDArray[np.bool_]


def cache_folder(cache: str) -> Path | None:
    """Folder of entries: `cache`, ORTHONAV_CACHE or the user's cache folder; None for "none"."""
    if cache == "none":
        return None
    if cache:
        return Path(cache).expanduser()
    if own := os.environ.get("ORTHONAV_CACHE"):
        return Path(own) / "sam"
    users = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(users).expanduser() / "orthonav" / "sam"


def cached(path: Path, shape: tuple[int, ...]) -> Mask | None:
    """Edge map (H, W) of a cache entry; None if the entry is absent or damaged."""
    try:
        entry = path.read_bytes()
        digest, packed = entry[:_DIGEST_BYTES], entry[_DIGEST_BYTES:]
        if hashlib.sha256(packed).digest() != digest:
            log.warning("damaged cache entry; computing it again: %s", path)
            return None
        bits = np.unpackbits(np.frombuffer(zlib.decompress(packed), np.uint8))
        return bits[: shape[0] * shape[1]].reshape(shape).astype(bool)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, zlib.error) as error:
        log.warning("unreadable cache entry (%s): %s", error, path)
        return None


def keep(path: Path, edges: Mask) -> None:
    """Write a cache entry; if that fails, log a warning and go on without it."""
    packed = zlib.compress(np.packbits(edges).tobytes())
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(hashlib.sha256(packed).digest() + packed)
    except OutputError as error:
        log.warning("could not write the cache entry: %s", error)
