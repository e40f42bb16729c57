"""The file systems of an atlas: a local folder, and fsspec for object storage and servers.

Names are those of files in the atlas (`folder/file`), already checked. Errors are those of the
system; `orthonav.atlas.store` converts them. The folder does not go through fsspec: its local
file system neither syncs files to disk before it renames them nor refuses links that lead outside.
"""

import contextlib
import os
import shutil
import threading
import uuid
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from orthonav.atlas.storage_errors import PACKAGES
from orthonav.errors import MissingExtraError, StorageError
from orthonav.extras import needed
from orthonav.files import replacing

_OBJECT_STORES = {"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oci", "oss", "memory"}
"""There a file appears when it is complete; elsewhere it is moved to its name."""
_FINDS_BY_PREFIX = {"s3", "s3a", "gs", "gcs"}
_NEEDS_OVERWRITE = {"abfs", "abfss", "az"}
"""Protocols that refuse to replace a file unless `overwrite` is passed."""


class LocalFolder:
    """A folder of this machine. Links that lead outside it are refused."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, name: str, follow: bool = True) -> Path:
        """The path of a file; without `follow` the file itself may be a link to anywhere."""
        path = self.root.joinpath(*name.split("/")) if name else self.root
        real = path.resolve() if follow or not name else path.parent.resolve()
        if not real.is_relative_to(self.root.resolve()):
            raise StorageError(f"a link leads out of the atlas: {path}")
        return path

    def names(self, folder: str, prefix: str) -> dict[str, int]:
        """Names and sizes of the files in a folder; empty where there is no such folder."""
        found = {}
        try:
            with os.scandir(self.path(folder)) as entries:
                for entry in entries:
                    if entry.name.startswith(prefix) and not entry.is_dir():
                        with contextlib.suppress(FileNotFoundError):  # removed meanwhile
                            found[entry.name] = entry.stat(follow_symlinks=False).st_size
        except (FileNotFoundError, NotADirectoryError):
            return {}
        return found

    def size(self, name: str) -> int | None:
        """Bytes of a file, None where it does not exist."""
        path = self.path(name)
        return path.stat().st_size if path.is_file() else None

    def modified_s(self, name: str) -> float | None:
        """When a file was written, seconds since 1970; None where unknown."""
        return self.path(name, follow=False).lstat().st_mtime

    def read(self, names: Sequence[str]) -> dict[str, bytes]:
        """Contents of files."""
        folders = {name.rpartition("/")[0] for name in names}
        real = {folder: self.path(folder).resolve() for folder in folders}
        found = {}
        for name in names:
            folder, _, file = name.rpartition("/")
            path = real[folder] / file
            found[name] = (self.path(name) if path.is_symlink() else path).read_bytes()
        return found

    def get(self, name: str, path: Path) -> None:
        """Copy a file to a local path."""
        shutil.copyfile(self.path(name), path)

    def put(self, path: Path, name: str) -> None:
        """Copy a local file to a name, whole or not at all."""
        with replacing(self.path(name)) as temporary:
            shutil.copyfile(path, temporary)

    def write(self, name: str, data: bytes) -> None:
        """Write a file, whole or not at all."""
        with replacing(self.path(name)) as temporary:
            temporary.write_bytes(data)

    def remove(self, name: str) -> None:
        """Remove a file if it exists."""
        self.path(name, follow=False).unlink(missing_ok=True)


class RemoteFiles:
    """A file system of fsspec, with the methods of `LocalFolder`.

    Each thread and process opens its own.
    """

    def __init__(self, url: str, protocol: str) -> None:
        self._url = url
        self._protocol = protocol
        self._of_threads = threading.local()
        self._opened()

    def names(self, folder: str, prefix: str) -> dict[str, int]:
        """See `LocalFolder.names`."""
        fs, path = self._at(folder)
        fs.invalidate_cache()
        try:
            if prefix and self._protocol in _FINDS_BY_PREFIX:
                found = list(fs.find(path, prefix=prefix, detail=True).values())
            else:
                found = fs.ls(path, detail=True)
        except FileNotFoundError:
            return {}
        sizes = {}
        for each in found:
            parent, _, name = each["name"].strip("/").rpartition("/")
            if each["type"] == "file" and parent == path.strip("/") and name.startswith(prefix):
                sizes[name] = int(each["size"])
        return sizes

    def size(self, name: str) -> int | None:
        """See `LocalFolder.size`."""
        fs, path = self._at(name)
        fs.invalidate_cache()
        try:
            info = fs.info(path)
        except FileNotFoundError:
            return None
        return int(info["size"]) if info["type"] == "file" else None

    def modified_s(self, name: str) -> float | None:
        """See `LocalFolder.modified_s`."""
        fs, path = self._at(name)
        try:
            when = fs.modified(path)
        except NotImplementedError:
            when = fs.info(path).get("mtime")
        if isinstance(when, datetime):
            return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
        return float(when) if isinstance(when, int | float) else None

    def read(self, names: Sequence[str]) -> dict[str, bytes]:
        """See `LocalFolder.read`; many files are read at the same time."""
        if not names:
            return {}
        fs = self._opened()[0]
        paths = [self._at(name)[1] for name in names]
        found = fs.cat(paths) if len(paths) > 1 else {paths[0]: fs.cat_file(paths[0])}
        return {name: found[path] for name, path in zip(names, paths, strict=True)}

    def get(self, name: str, path: Path) -> None:
        """See `LocalFolder.get`."""
        fs, far_path = self._at(name)
        fs.get_file(far_path, str(path))

    def put(self, path: Path, name: str) -> None:
        """See `LocalFolder.put`."""
        more = {"overwrite": True} if self._protocol in _NEEDS_OVERWRITE else {}
        self._send(name, lambda fs, far_path: fs.put_file(str(path), far_path, **more))

    def write(self, name: str, data: bytes) -> None:
        """See `LocalFolder.write`."""
        self._send(name, lambda fs, far_path: fs.pipe_file(far_path, data))

    def remove(self, name: str) -> None:
        """See `LocalFolder.remove`."""
        fs, path = self._at(name)
        with contextlib.suppress(FileNotFoundError):
            fs.rm_file(path)

    def _send(self, name: str, send: Callable[[Any, str], None]) -> None:
        fs, path = self._at(name)
        if self._protocol in _OBJECT_STORES:
            send(fs, path)
            return
        folder, _, file = path.rpartition("/")
        fs.makedirs(folder, exist_ok=True)
        temporary = f"{folder}/.{file}.{uuid.uuid4().hex[:12]}.tmp"
        try:
            send(fs, temporary)
            fs.mv(temporary, path)
        except BaseException:
            with contextlib.suppress(Exception):
                fs.rm_file(temporary)
            raise

    def _at(self, name: str) -> tuple[Any, str]:
        fs, root = self._opened()
        return fs, f"{root.rstrip('/')}/{name}" if name else root.rstrip("/")

    def _opened(self) -> tuple[Any, str]:
        mine = getattr(self._of_threads, "opened", None)
        if mine is None or mine[0] != os.getpid():
            mine = (os.getpid(), *_open(self._url, self._protocol))
            self._of_threads.opened = mine
        return mine[1], mine[2]


def _open(url: str, protocol: str) -> tuple[Any, str]:
    fsspec = needed("fsspec", "atlas", "an atlas in object storage")
    try:
        fsspec.get_filesystem_class(protocol)
        fs, path = fsspec.core.url_to_fs(url)
    except ValueError as error:
        raise StorageError(f"invalid address ({error}): {protocol}://") from error
    except ImportError as error:
        package = PACKAGES.get(protocol)
        wanted = package or f"a package that is not installed ({error})"
        how = f", which is not installed: pip install {package}" if package else ""
        raise MissingExtraError(f"an atlas at {protocol}:// needs {wanted}{how}") from error
    return fs, path
