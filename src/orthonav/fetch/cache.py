"""What was fetched, on disk, so that a run that was killed fetches only what is missing.

One file per cell, named by a hash of its address without keys. Each is written under a temporary
name and renamed, and its content is checked when it is read: what a kill or a full disk left
broken counts as missing.
"""

import hashlib
import os
import shutil
import threading
from dataclasses import dataclass
from pathlib import Path

from orthonav.errors import OutputError

_MAGIC = b"ORTHONAV-CELL-1\n"
_MARKER = "orthonav-fetch-cache"
_DIGEST = 32
_ABSENT, _PICTURE = b"-", b"+"


@dataclass(frozen=True, eq=False)
class Entry:
    """A stored answer: `body`, or None where the service has nothing there; `digest` of it."""

    body: bytes | None
    digest: bytes


class FileCache:
    """Answers by address, in a folder; several threads may use it."""

    def __init__(self, folder: Path) -> None:
        """Raises `OutputError` where the folder cannot be made or holds something else."""
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            marker = self.folder / _MARKER
            if not marker.exists():
                if any(self.folder.iterdir()):
                    raise OutputError(
                        f"cache folder holds something else; name an empty one: {self.folder}"
                    )
                marker.write_text("Answers of services, kept by orthonav fetch.\n")
        except OutputError:
            raise
        except OSError as error:
            raise OutputError(
                f"cache folder cannot be used ({error.strerror or error}): {self.folder}"
            ) from error

    def read(self, address: str) -> Entry | None:
        """The stored answer, or None where there is none or it is broken."""
        path = self._path(address)
        try:
            data = path.read_bytes()
        except OSError:
            return None
        head = len(_MAGIC) + 1 + _DIGEST
        kind, digest, body = (
            data[len(_MAGIC) : len(_MAGIC) + 1],
            data[head - _DIGEST : head],
            data[head:],
        )
        whole = data[: len(_MAGIC)] == _MAGIC and hashlib.sha256(kind + body).digest() == digest
        if not whole or kind not in (_ABSENT, _PICTURE):
            path.unlink(missing_ok=True)
            return None
        return Entry(None if kind == _ABSENT else body, digest)

    def write(self, address: str, body: bytes | None) -> None:
        """Store an answer. Raises `OutputError` where the disk refuses."""
        kind = _ABSENT if body is None else _PICTURE
        digest = hashlib.sha256(kind + (body or b"")).digest()
        path = self._path(address)
        temporary = path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}.tmp")
        try:
            path.parent.mkdir(exist_ok=True)
            temporary.write_bytes(_MAGIC + kind + digest + (body or b""))
            temporary.replace(path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise OutputError(
                f"cannot keep what was fetched ({error.strerror or error}): {self.folder}"
            ) from error

    def remove(self) -> None:
        """Remove the folder and all that is in it."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, address: str) -> Path:
        name = hashlib.sha256(address.encode()).hexdigest()
        return self.folder / name[:2] / name[2:]
