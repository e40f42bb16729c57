"""Temporary folders for sheets under construction; folders of killed processes are removed."""

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from orthonav.errors import OutputError

try:
    import fcntl
except ImportError:  # not a Unix: the system removes what killed processes left behind
    fcntl = None  # type: ignore[assignment]

PREFIX = "orthonav-sheet-"
_LOCK = "in-use"


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A new folder in the system's folder of temporary files (`TMPDIR`), removed afterwards.

    Folders of processes that were killed are removed first. Raises `OutputError`.
    """
    root = Path(tempfile.gettempdir())
    _remove_abandoned(root)
    try:
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=root))
    except OSError as error:
        raise OutputError(f"no temporary folder can be made ({error.strerror}): {root}") from error
    lock = None
    try:
        lock = _locked(folder)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            lock.close()


def _locked(folder: Path) -> IO[str] | None:
    """A lock that the system releases when this process ends, in whatever way."""
    if fcntl is None:
        return None
    lock = (folder / f".{_LOCK}").open("w")
    fcntl.flock(lock, fcntl.LOCK_EX)
    (folder / f".{_LOCK}").rename(folder / _LOCK)  # visible to others only when locked
    return lock


def _remove_abandoned(root: Path) -> None:
    for path in root.glob(f"{PREFIX}*/{_LOCK}") if fcntl is not None else ():
        with contextlib.suppress(OSError), path.open("r+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(path.parent, ignore_errors=True)
