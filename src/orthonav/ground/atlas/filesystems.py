"""The file systems of an atlas: a local folder, and fsspec for object storage and servers.

Names are those of files in the atlas (`folder/file`), already checked. Errors are those of the
system; `orthonav.ground.atlas.store` converts them. The folder does not go through fsspec: its
local file system neither syncs files to disk before it renames them nor refuses links that lead
outside.
"""

import contextlib
import os
import shutil
import uuid
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from orthonav.core.errors import MissingExtraError, StorageError
from orthonav.core.extras import needed
from orthonav.core.files import replacing

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

    def save(self, content: Path | bytes, name: str) -> None:
        """Write a file with the content of a local file, or these bytes; whole or not at all."""
        with replacing(self.path(name)) as temporary:
            if isinstance(content, Path):
                shutil.copyfile(content, temporary)
            else:
                temporary.write_bytes(content)

    def remove(self, name: str) -> None:
        """Remove a file if it exists."""
        self.path(name, follow=False).unlink(missing_ok=True)


class RemoteFiles:
    """A file system of fsspec, with the methods of `LocalFolder`."""

    def __init__(self, url: str, protocol: str) -> None:
        self._protocol = protocol
        self._fsspec = needed("fsspec", "atlas", "an atlas in object storage")
        self._url = url
        self._at("")

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
        fs, root = self._at("")
        paths = [f"{root}/{name}" for name in names]
        found = fs.cat(paths) if len(paths) > 1 else {paths[0]: fs.cat_file(paths[0])}
        return {name: found[path] for name, path in zip(names, paths, strict=True)}

    def get(self, name: str, path: Path) -> None:
        """Copy a file to a local path."""
        fs, far_path = self._at(name)
        fs.get_file(far_path, str(path))

    def save(self, content: Path | bytes, name: str) -> None:
        """See `LocalFolder.save`."""
        fs, path = self._at(name)
        if self._protocol in _OBJECT_STORES:
            self._send(fs, content, path)
            return
        folder, _, file = path.rpartition("/")
        fs.makedirs(folder, exist_ok=True)
        temporary = f"{folder}/.{file}.{uuid.uuid4().hex[:12]}.tmp"
        try:
            self._send(fs, content, temporary)
            fs.mv(temporary, path)
        except BaseException:
            with contextlib.suppress(Exception):
                fs.rm_file(temporary)
            raise

    def _send(self, fs: Any, content: Path | bytes, path: str) -> None:
        if isinstance(content, bytes):
            fs.pipe_file(path, content)
        else:
            more = {"overwrite": True} if self._protocol in _NEEDS_OVERWRITE else {}
            fs.put_file(str(content), path, **more)

    def remove(self, name: str) -> None:
        """See `LocalFolder.remove`."""
        fs, path = self._at(name)
        with contextlib.suppress(FileNotFoundError):
            fs.rm_file(path)

    def _at(self, name: str) -> tuple[Any, str]:
        """The file system and a path on it. fsspec keeps one per process and thread."""
        try:
            self._fsspec.get_filesystem_class(self._protocol)
            fs, root = self._fsspec.core.url_to_fs(self._url)
        except ValueError as error:
            raise StorageError(f"invalid address ({error}): {self._protocol}://") from error
        except ImportError as error:
            raise MissingExtraError(
                f"an atlas at {self._protocol}:// needs a package that is not installed ({error})"
            ) from error
        return fs, f"{root.rstrip('/')}/{name}" if name else root.rstrip("/")
