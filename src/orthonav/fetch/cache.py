"""Answers on disk, so that an interrupted run resumes with the cells that are missing.

One file per cell, named by a hash of its address without keys. Each is written under a temporary
name and renamed, and its checksum is verified when it is read: a file that a kill or a full disk
left incomplete counts as missing.
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
_ABSENT, _IMAGE = b"-", b"+"


@dataclass(frozen=True, eq=False)
class CachedCell:
    """A stored cell: `body`, or None where the service has no imagery; `digest` of it."""

    body: bytes | None
    digest: bytes


class FileCache:
    """Cells by address, in a folder; several threads may use it."""

    def __init__(self, folder: Path) -> None:
        """Raises `OutputError` where the folder cannot be created or holds other files."""
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            marker = self.folder / _MARKER
            if not marker.exists():
                if any(self.folder.iterdir()):
                    raise OutputError(
                        f"cache folder holds other files; choose an empty one: {self.folder}"
                    )
                marker.write_text("Answers of services, kept by orthonav fetch.\n")
        except OSError as error:
            if isinstance(error, OutputError):
                raise
            raise OutputError(
                f"cache folder cannot be used ({error.strerror or error}): {self.folder}"
            ) from error

    def read(self, address: str) -> CachedCell | None:
        """The stored cell, or None where there is none or it is damaged."""
        path = self._path(address)
        try:
            data = path.read_bytes()
        except OSError:
            return None
        head = len(_MAGIC) + 1 + _DIGEST
        magic, digest, body = data[: len(_MAGIC)], data[head - _DIGEST : head], data[head:]
        kind = data[len(_MAGIC) : len(_MAGIC) + 1]
        whole = magic == _MAGIC and hashlib.sha256(kind + body).digest() == digest
        if not whole or kind not in (_ABSENT, _IMAGE):
            path.unlink(missing_ok=True)
            return None
        return CachedCell(None if kind == _ABSENT else body, digest)

    def write(self, address: str, body: bytes | None) -> None:
        """Store a cell. Raises `OutputError` where it cannot be written."""
        kind = _ABSENT if body is None else _IMAGE
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
                f"cannot store a fetched cell ({error.strerror or error}): {self.folder}"
            ) from error

    def remove(self) -> None:
        """Remove the folder and its content."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, address: str) -> Path:
        name = hashlib.sha256(address.encode()).hexdigest()
        return self.folder / name[:2] / name[2:]
