"""The files of an atlas, in a local folder or by fsspec in object storage and on servers.

A file exists completely or not at all: locally it is written to a temporary name and renamed, and
object stores show a file when it is complete. No file outside the atlas is ever named, because the
catalogue may come from an untrusted source. Remote files are copied to a cache and verified, which
the cache of fsspec does not do. Nor does a folder go through fsspec: its local file system neither
syncs files to disk before it renames them nor refuses links that lead outside."""

import contextlib
import functools
import hashlib
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from orthonav.core.errors import MissingExtraError, OrthonavError, StorageError, described
from orthonav.core.extras import needed
from orthonav.core.files import replacing

MAX_READ_BYTES = 64 * 2**20  # a guard for memory: catalogue and index manifest are smaller


class Store:
    """The files of one atlas by name (`folder/file`). Can be used by several threads. Every failure
    is a `StorageError` with its cause, or `MissingExtraError` where the package of a protocol is
    not installed. `str()` gives the address without a password."""

    def __init__(self, url: str) -> None:
        match = re.match(r"([a-z][a-z0-9+.-]*)://", url, re.IGNORECASE)
        self._protocol = match.group(1).lower() if match else "file"
        self.is_local = self._protocol in ("file", "local")
        if self.is_local:
            self._root = Path(url[match.end() :] if match else url).expanduser().absolute()
            self.url = str(self._root)
            return
        self.url = url.rstrip("/")
        with storage_errors(str(self), "open the storage"):
            self._fsspec = needed("fsspec", "atlas", "an atlas in object storage")
            self._remote("")

    def __str__(self) -> str:
        return self.url if self.is_local else re.sub(r"(://[^/@:]*):[^/]*@", r"\1@", self.url)

    def names(self, folder: str = "") -> dict[str, int]:
        """Names of the files of a folder, sorted, and their sizes. Subfolders are left out. Empty
        where there is no such folder."""
        found: dict[str, int] = {}
        with storage_errors(self.shown(folder), "list the files of the atlas"):
            folder = checked_name(folder) if folder else ""
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                if self.is_local:
                    found = _listed(self._path(folder))
                else:
                    found = self._listed_remote(folder)
        return dict(sorted(found.items()))

    def size(self, name: str) -> int | None:
        with storage_errors(self.shown(name), "access the atlas"):
            if self.is_local:
                path = self._path(checked_name(name))
                return path.stat().st_size if path.is_file() else None
            fs, remote_path = self._remote(checked_name(name))
            fs.invalidate_cache()
            try:
                info = fs.info(remote_path)
            except FileNotFoundError:
                return None
            return int(info["size"]) if info["type"] == "file" else None

    def age_s(self, name: str) -> float:
        with storage_errors(self.shown(name), "access the atlas"):
            if self.is_local:
                return time.time() - self._path(checked_name(name)).stat().st_mtime
            fs, remote_path = self._remote(checked_name(name))
            when: datetime = fs.modified(remote_path)
            return time.time() - (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()

    def read(self, name: str, limit_bytes: int = MAX_READ_BYTES) -> bytes:
        size = self.size(name)
        if size is not None and size > limit_bytes:
            raise StorageError(
                f"file has {size} bytes, at most {limit_bytes} are allowed: {self.shown(name)}"
            )
        content = self.read_many([name]).get(name)
        if content is None:
            raise StorageError(f"the atlas has no such file: {self.shown(name)}")
        return content

    def read_many(self, names: Iterable[str]) -> dict[str, bytes]:
        """Contents of files; files that another process has removed are left out."""
        with storage_errors(str(self), "read files of the atlas"):
            found: dict[str, Any] = {}
            names = [checked_name(name) for name in names]
            if self.is_local:
                for name in names:
                    with contextlib.suppress(FileNotFoundError):
                        found[name] = self._path(name).read_bytes()
            elif names:
                fs, root = self._remote("")
                paths = {f"{root}/{name}": name for name in names}
                there = fs.cat(list(paths), recursive=False, on_error="return")
                found = {paths[path]: content for path, content in there.items()}
            for name, content in list(found.items()):
                if isinstance(content, FileNotFoundError):
                    del found[name]
                elif isinstance(content, Exception):
                    raise content
            return found

    def fetch(self, name: str, size: int, sha256: str) -> Path:
        """A local file with that content, verified once: the file itself or a cached copy. Several
        processes may use the cache at the same time."""
        if self.is_local:
            with storage_errors(self.shown(name), "read the atlas"):
                path = self._path(checked_name(name))
                if not path.is_file():
                    raise StorageError(f"the atlas has no such file: {self.shown(name)}")
                _require(path, size, sha256, self.shown(name))
            return path
        folder = cache_folder()
        path = folder / sha256[:2] / f"{sha256}{Path(checked_name(name)).suffix}"
        with storage_errors(str(folder), "write to the cache of the atlas (ORTHONAV_CACHE)"):
            if path.is_file() and path.stat().st_size == size:
                return path
            with replacing(path) as temporary:
                self.download(name, temporary)
                _require(temporary, size, sha256, self.shown(name))
        return path

    def download(self, name: str, path: Path) -> None:
        with storage_errors(self.shown(name), f"copy from the atlas to {path.parent}"):
            fs, remote_path = self._remote(checked_name(name))
            fs.get_file(remote_path, str(path))

    def write(self, name: str, content: Path | bytes) -> None:
        with storage_errors(self.shown(name), "write to the atlas"):
            if not self.is_local:
                fs, path = self._remote(checked_name(name))
                if isinstance(content, bytes):
                    fs.pipe_file(path, content)
                else:
                    # Azure refuses to replace a file unless told.
                    is_azure = self._protocol in ("abfs", "abfss", "az")
                    more = {"overwrite": True} if is_azure else {}
                    fs.put_file(str(content), path, **more)
                return
            with replacing(self._path(checked_name(name))) as temporary:
                if isinstance(content, Path):
                    shutil.copyfile(content, temporary)
                else:
                    temporary.write_bytes(content)

    def remove(self, name: str) -> None:
        with (
            storage_errors(self.shown(name), "remove a file of the atlas"),
            contextlib.suppress(FileNotFoundError),
        ):
            if self.is_local:
                self._path(checked_name(name)).unlink()
            else:
                fs, remote_path = self._remote(checked_name(name))
                fs.rm_file(remote_path)

    def shown(self, name: str) -> str:
        return f"{self}/{name:.200}" if name else str(self)

    def _path(self, name: str) -> Path:
        path = self._root / name
        if not path.resolve().is_relative_to(self._root.resolve()):
            raise StorageError(f"a link leads out of the atlas: {path}")
        return path

    def _remote(self, name: str) -> tuple[Any, str]:
        try:
            self._fsspec.get_filesystem_class(self._protocol)
            fs, root = self._fsspec.core.url_to_fs(self.url)
        except ValueError as error:
            raise StorageError(f"invalid address ({error}): {self._protocol}://") from error
        except ImportError as error:
            raise MissingExtraError(
                f"an atlas at {self._protocol}:// needs a package that is not installed ({error})"
            ) from error
        return fs, f"{root.rstrip('/')}/{name}" if name else root.rstrip("/")

    def _listed_remote(self, folder: str) -> dict[str, int]:
        fs, path = self._remote(folder)
        fs.invalidate_cache()
        sizes = {}
        for each in fs.ls(path, detail=True):
            parent, _, name = each["name"].strip("/").rpartition("/")
            if each["type"] == "file" and parent == path.strip("/"):
                sizes[name] = int(each["size"])
        return sizes


def _listed(folder: Path) -> dict[str, int]:
    found = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.is_dir():
                with contextlib.suppress(FileNotFoundError):  # removed meanwhile
                    found[entry.name] = entry.stat(follow_symlinks=False).st_size
    return found


def checked_name(name: str) -> str:
    parts = name.split("/")
    possible = re.compile(r"[A-Za-z0-9._-]{1,200}")
    if not all(possible.fullmatch(part) and part not in (".", "..") for part in parts):
        raise StorageError(f"invalid name of a file in an atlas: {name!r:.120}")
    return name


def digest_of(path: Path) -> str:
    state = path.stat()
    return _digest(path, state.st_size, state.st_mtime_ns)


@functools.cache
def _digest(path: Path, size: int, changed_ns: int) -> str:
    """The digest of a file that has not changed is not computed again."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _require(path: Path, size: int, sha256: str, shown: str) -> None:
    found = path.stat().st_size
    if found != size:
        wrong = f"incomplete or altered: {found} bytes, the catalogue has {size}"
    elif digest_of(path) != sha256:
        wrong = "damaged or altered: its checksum differs from the catalogue's"
    else:
        return
    raise StorageError(f"{wrong}; 'orthonav atlas check --deep' finds all such files: {shown}")


def cache_folder() -> Path:
    own = os.environ.get("ORTHONAV_CACHE")
    if own:
        return Path(own).expanduser()
    users = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(users).expanduser() / "orthonav" / "atlas"


@contextmanager
def storage_errors(place: str, action: str) -> Iterator[None]:
    """Turn every error into `StorageError` with the cause: the libraries behind fsspec raise many
    kinds. `action`: what was attempted, a verb and its object."""
    try:
        yield
    except OrthonavError as error:
        if isinstance(error, StorageError | MissingExtraError):
            raise
        raise StorageError(str(error)) from error
    except Exception as error:
        why = f"{type(error).__name__}: {described(error)}"
        raise StorageError(f"cannot {action}: {why}: {place}") from error
