"""Local copies of files of a remote atlas, named by their content; the least used are removed.

fsspec's own file cache neither verifies contents nor limits its size, so it is not used.
"""

import contextlib
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

from orthonav.atlas.storage_errors import storage_errors
from orthonav.errors import StorageError

log = logging.getLogger(__name__)

LIMIT_BYTES = 20 * 10**9
"""Some 200 sheets of 100 km2 at 1 m, 70 to 100 MB each (docs/country.md)."""
GRACE_S = 600.0
"""Files used within this time are not removed: a process may be about to open them."""


def cache_folder() -> Path:
    """The folder of the cache: `ORTHONAV_CACHE`, otherwise the cache folder of the user."""
    own = os.environ.get("ORTHONAV_CACHE")
    if own:
        return Path(own).expanduser()
    users = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(users).expanduser() / "orthonav" / "atlas"


def cache_limit_bytes() -> int:
    """Size limit of the cache: `ORTHONAV_CACHE_GB`, otherwise 20 GB. Raises `StorageError`."""
    gigabytes = os.environ.get("ORTHONAV_CACHE_GB")
    try:
        return int(float(gigabytes) * 1e9) if gigabytes else LIMIT_BYTES
    except (ValueError, OverflowError) as error:
        raise StorageError(f"ORTHONAV_CACHE_GB must be a number, got {gigabytes!r:.40}") from error


def cached(folder: Path | None, name: str, size: int, fill: Callable[[Path], None]) -> Path:
    """The file of the cache that is named by its SHA-256; if missing, `fill` writes it, verified.

    Several processes may use a cache at the same time. `folder` None: see `cache_folder`.
    """
    folder, limit_bytes = folder or cache_folder(), cache_limit_bytes()
    path = folder / name[:2] / name
    with storage_errors(str(folder), "write to the cache of the atlas (ORTHONAV_CACHE)"):
        if path.is_file() and path.stat().st_size == size:
            os.utime(path)  # last used now
            return path
        fill(path)
        _shrink(folder, limit_bytes, path)
    return path


def _shrink(folder: Path, limit_bytes: int, newest: Path) -> None:
    """Remove the least recently used files until the limit holds."""
    files = []
    for path in folder.glob("??/*"):
        with contextlib.suppress(FileNotFoundError):  # removed by another process
            state = path.stat()
            files.append((state.st_mtime, state.st_size, path))
    excess = sum(size for _, size, _ in files) - limit_bytes
    for used, size, path in sorted(files):
        if excess <= 0:
            return
        if path != newest and time.time() - used > GRACE_S:
            path.unlink(missing_ok=True)
            excess -= size
            log.debug("cache: removed %s", path.name)
