"""Files of a far atlas kept on this machine: named by their content, the least used go first."""

import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

from orthonav.atlas.trouble import told
from orthonav.errors import StorageError

log = logging.getLogger(__name__)

LIMIT_BYTES = 20 * 10**9
GRACE_S = 600.0
"""Files used since are never removed: somebody is about to open them."""


def cache_folder() -> Path:
    """Where files are kept: `ORTHONAV_CACHE`, else the user's folder for such things."""
    own = os.environ.get("ORTHONAV_CACHE")
    if own:
        return Path(own).expanduser()
    users = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(users).expanduser() / "orthonav" / "atlas"


def cache_limit_bytes() -> int:
    """How much may be kept: `ORTHONAV_CACHE_GB`, else 20 GB. Raises `StorageError`."""
    told_gb = os.environ.get("ORTHONAV_CACHE_GB")
    try:
        return int(float(told_gb) * 1e9) if told_gb else LIMIT_BYTES
    except (ValueError, OverflowError) as error:
        raise StorageError(f"ORTHONAV_CACHE_GB must be a number, got {told_gb!r:.40}") from error


class ContentCache:
    """A folder of files named by their SHA-256, at most about `limit_bytes` of them.

    Many processes may use it at once.
    """

    def __init__(self, folder: Path, limit_bytes: int = LIMIT_BYTES) -> None:
        self.folder = folder
        self.limit_bytes = limit_bytes

    def get(self, sha256: str, suffix: str, size: int, fill: Callable[[Path], None]) -> Path:
        """The file of that content; `fill` writes it to a path, verified, where it is not here."""
        path = self.folder / sha256[:2] / f"{sha256}{suffix}"
        with told(str(self.folder), "keep files of the atlas in its cache (ORTHONAV_CACHE)"):
            if path.is_file() and path.stat().st_size == size:
                os.utime(path)  # last used now
                return path
            fill(path)
            self._shrink(path)
        return path

    def _shrink(self, newest: Path) -> None:
        """Remove what was not used for longest until the limit holds."""
        files = []
        for path in self.folder.glob("??/*"):
            try:
                state = path.stat()
            except FileNotFoundError:  # another process was faster
                continue
            files.append((state.st_mtime, state.st_size, path))
        too_much = sum(size for _, size, _ in files) - self.limit_bytes
        for used, size, path in sorted(files):
            if too_much <= 0:
                return
            if path != newest and time.time() - used > GRACE_S:
                path.unlink(missing_ok=True)
                too_much -= size
                log.debug("cache: removed %s", path.name)
