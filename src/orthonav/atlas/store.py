"""Where an atlas lies: a folder, or object storage reached through fsspec.

A file is there whole or not at all. Locally it is written beside its place and renamed. Object
stores show a file only when all of it has arrived. Elsewhere (SFTP) it is moved into its place.
Nothing outside the atlas is ever named: catalogues may come from strangers.
"""

import hashlib
import re
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from orthonav.atlas.cache import ContentCache, cache_folder, cache_limit_bytes
from orthonav.atlas.places import Far, Folder, Place
from orthonav.atlas.trouble import told
from orthonav.errors import StorageError
from orthonav.files import replacing

MAX_READ_BYTES = 64 * 2**20
_PART = re.compile(r"[A-Za-z0-9._-]{1,200}")
_PROTOCOL = re.compile(r"([a-z][a-z0-9+.-]*)://", re.IGNORECASE)
_PASSWORD = re.compile(r"(://[^/@:]*):[^/]*@")


class Store:
    """The files of one atlas by their names (`folder/file`). May be pickled and used by threads.

    Every failure is a `StorageError` that says what is wrong; `MissingExtraError` where the package
    of a protocol is not installed. Printed, it is the address without a password.
    """

    def __init__(self, url: str, cache: Path | None = None) -> None:
        match = _PROTOCOL.match(url)
        protocol = match.group(1).lower() if match else "file"
        self.is_local = protocol in ("file", "local")
        self.cache = cache
        self._verified: set[tuple[str, int, int]] = set()
        if self.is_local:
            folder = Path(url[match.end() :] if match else url).expanduser().absolute()
            self.url = str(folder)
            self._folder = Folder(folder)
            self._place: Place = self._folder
        else:
            self.url = url.rstrip("/")
            with told(str(self), "open the storage"):
                self._place = Far(self.url, protocol)

    @classmethod
    def open(cls, url: str, *, cache: Path | None = None) -> "Store":
        """The store at a folder or URL, which need not exist yet.

        `cache` is the folder where files of far stores are kept, None: see `cache_folder`.
        """
        return cls(str(url), cache)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.url, self.cache)

    def __str__(self) -> str:
        if self.is_local:
            return self.url
        return _PASSWORD.sub(r"\1@", self.url)

    def names(self, folder: str = "", prefix: str = "") -> dict[str, int]:
        """Names of the files of a folder that begin with `prefix`, and their sizes, in order.

        Files of folders in it are left out. Empty where the folder is not there.
        """
        with told(self.shown(folder), "list the files of the atlas"):
            found = self._place.names(checked_name(folder) if folder else "", prefix)
        return dict(sorted(found.items()))

    def size(self, name: str) -> int | None:
        """Bytes of a file, None where it is not there."""
        with told(self.shown(name), "look at the atlas"):
            return self._place.size(checked_name(name))

    def age_s(self, name: str) -> float | None:
        """Seconds since a file was written, None where the store does not tell."""
        with told(self.shown(name), "look at the atlas"):
            changed = self._place.changed_s(checked_name(name))
        return None if changed is None else time.time() - changed

    def read(self, name: str, limit_bytes: int = MAX_READ_BYTES) -> bytes:
        """Content of a file of at most so many bytes."""
        size = self.size(name)
        if size is None:
            raise StorageError(f"the atlas has no such file: {self.shown(name)}")
        if size > limit_bytes:
            raise StorageError(f"larger than such a file may be ({size} bytes): {self.shown(name)}")
        return self.read_many([name])[name]

    def read_many(self, names: Iterable[str]) -> dict[str, bytes]:
        """Contents of small files, all at once where the store can."""
        with told(str(self), "read files of the atlas"):
            return self._place.read([checked_name(name) for name in names])

    def fetch(self, name: str, size: int, sha256: str) -> Path:
        """A local file with that content, verified once: the file itself, or one in the cache."""
        if self.is_local:
            return self._verified_here(name, size, sha256)

        def fill(path: Path) -> None:
            with replacing(path) as temporary:
                self.download(name, temporary)
                _require(temporary, size, sha256, self.shown(name))

        cache = ContentCache(self.cache or cache_folder(), cache_limit_bytes())
        return cache.get(sha256, Path(checked_name(name)).suffix, size, fill)

    def download(self, name: str, path: Path) -> None:
        """Copy a file of the atlas to `path`, as it is."""
        with told(self.shown(name), f"copy from the atlas to {path.parent}"):
            self._place.get(checked_name(name), path)

    def put(self, path: Path, name: str) -> None:
        """Copy a local file into the atlas, whole or not at all."""
        with told(self.shown(name), "write to the atlas"):
            self._place.put(path, checked_name(name))

    def write(self, name: str, data: bytes) -> None:
        """Write a small file, whole or not at all."""
        with told(self.shown(name), "write to the atlas"):
            self._place.write(checked_name(name), data)

    def remove(self, name: str) -> None:
        """Remove a file; nothing happens where it is not there."""
        with told(self.shown(name), "remove a file of the atlas"):
            self._place.remove(checked_name(name))

    def shown(self, name: str) -> str:
        """A file of the atlas as people may see it."""
        return f"{self}/{name:.200}" if name else str(self)

    def _verified_here(self, name: str, size: int, sha256: str) -> Path:
        with told(self.shown(name), "read the atlas"):
            path = self._folder.path(checked_name(name))
            if not path.is_file():
                raise StorageError(f"the atlas has no such file: {self.shown(name)}")
            state = (sha256, path.stat().st_size, path.stat().st_mtime_ns)
            if state not in self._verified:
                _require(path, size, sha256, self.shown(name))
                self._verified.add(state)
        return path


def checked_name(name: str) -> str:
    """`name` if it is one of a file inside an atlas. Raises `StorageError`."""
    parts = name.split("/")
    if not all(_PART.fullmatch(part) and part not in (".", "..") for part in parts):
        raise StorageError(f"not a name of a file in an atlas: {name!r:.120}")
    return name


def digest_of(path: Path) -> str:
    """SHA-256 of a file, as hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _require(path: Path, size: int, sha256: str, shown: str) -> None:
    """Raise `StorageError` where a file is not what the catalogue says."""
    found = path.stat().st_size
    if found != size:
        wrong = f"half there or altered: {found} bytes, the catalogue says {size}"
    elif digest_of(path) != sha256:
        wrong = "damaged or altered: its checksum is not that of the catalogue"
    else:
        return
    raise StorageError(f"{wrong}; 'orthonav atlas check --deep' finds all such: {shown}")
