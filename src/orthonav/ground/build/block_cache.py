"""Cache of finished blocks in a folder, from which an interrupted build resumes.

A block is one file: arrays in NumPy's own container (a ZIP whose checksums are verified), written
to a temporary name and renamed. Its name holds a digest of everything that determines it, so blocks
of another request, of changed imagery or of another version are never used.
"""

import contextlib
import hashlib
import json
import logging
import re
import shutil
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, OutputError
from orthonav.core.files import replacing

if TYPE_CHECKING:
    from orthonav.ground.build.sheet import Block

log = logging.getLogger(__name__)

FORMAT = 2
"""Of the arrays of a block: increase it when they change."""
_OURS = re.compile(r"\.?r\d+-c\d+-[0-9a-f]{24}\.npz(\..*\.tmp\.npz)?")


def digest(values: Any) -> str:
    """SHA-256 of plain values as canonical JSON."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


class BlockCache:
    """A folder of finished blocks, created with the first block. May be shared between threads.

    As a context manager around a build it deletes the blocks when the build succeeds, or fails with
    an `AreaError`; on any other error or interrupt the blocks stay, and a warning is logged.
    """

    def __init__(self, folder: Path, request: str, needed_bytes: int) -> None:
        """`request`: digest of the inputs common to all blocks. `needed_bytes`: their total size.

        Raises `OutputError` if the disk has less free space.
        """
        self._folder = folder
        self._request = request
        self._names: dict[Block, str] = {}
        parent = next(each for each in [folder, *folder.absolute().parents] if each.exists())
        room = shutil.disk_usage(parent).free + sum(path.stat().st_size for path in self._files())
        if room < needed_bytes:
            raise OutputError(
                f"finished blocks need about {needed_bytes / 1e6:.0f} MB until the map is written, "
                f"but only {room / 1e6:.0f} MB are free; free disk space or name another folder "
                f"(--work): {folder}"
            )
        log.info("caching finished blocks in %s: about %.0f MB", folder, needed_bytes / 1e6)

    def __enter__(self) -> "BlockCache":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: Any
    ) -> None:
        if error is None or isinstance(error, AreaError):
            self.discard()
        elif count := len(self._files()):
            log.warning(
                "%d finished blocks are cached; rerun the same build to resume: %s",
                count,
                self._folder,
            )

    def begin(self, blocks: Sequence[tuple["Block", Any]]) -> int:
        """Register the blocks of a build, each with the inputs that it alone depends on.

        Removes files of other builds; returns the number of cached blocks.
        """
        self._names = {
            block: f"r{block.row}-c{block.col}-{digest([FORMAT, self._request, own])[:24]}.npz"
            for block, own in blocks
        }
        wanted = set(self._names.values())
        there = 0
        for path in self._files():
            if path.name in wanted:
                there += 1
            else:
                path.unlink(missing_ok=True)
        return there

    def load(self, block: "Block") -> dict[str, NDArray[Any]] | None:
        """The arrays of a block, None if it is not cached or damaged."""
        path = self._folder / self._names[block]
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
                return {name: stored[name] for name in stored.files}
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            log.warning("cached block is damaged (%s) and is recomputed: %s", error, path)
            return None

    def store(self, block: "Block", parts: dict[str, NDArray[Any]]) -> None:
        """Write a finished block, complete or not at all. Raises `OutputError`."""
        path = self._folder / self._names[block]
        try:
            with replacing(path) as temporary:
                np.savez(temporary, **parts)  # type: ignore[arg-type]  # none is `allow_pickle`
        except OutputError as error:
            raise OutputError(
                f"{error}; earlier blocks stay cached for a rerun of the same build; or name "
                "another folder (--work)"
            ) from error

    def discard(self) -> None:
        """Remove the blocks, and the folder if it is then empty."""
        for path in self._files():
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # missing, or not empty
            self._folder.rmdir()

    def _files(self) -> list[Path]:
        if not self._folder.is_dir():
            return []
        return [path for path in self._folder.iterdir() if _OURS.fullmatch(path.name)]
