"""Writing results so that a kill or a full disk leaves either the old file or the whole new one."""

import errno
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

from orthonav.core.errors import ArgumentError, MissingFileError, OutputError, lfs_pointer

StrPath = str | os.PathLike[str]
GivenPath: TypeAlias = Any
"""A `StrPath` when a record is made, which holds a `Path`: no type is both."""
Progress = Callable[[str, float], None]
"""Receives the stage of a long task and the fraction of it that is done, 0 to 1."""


def no_progress(stage: str, share: float) -> None:
    pass


_ALMOST_NONE = 2**20  # with less free space, bytes, a failed write is that of a full disk


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path, synced and renamed to `path` on success, else removed. Raises
    `OutputError`."""
    path = Path(path).resolve()
    require_writable(path)
    with _beside(path, f".tmp{path.suffix}") as temporary:
        try:
            yield temporary
            _sync(temporary)
            temporary.chmod(0o666 & ~_umask())
            temporary.replace(path)
        except OSError as error:
            if isinstance(error, MissingFileError | OutputError) or error.errno is None:
                raise
            raise _output_error(error, path) from error


@contextmanager
def replacing_folder(path: Path, is_ours: Callable[[Path], bool] | None = None) -> Iterator[Path]:
    """A temporary folder that replaces `path` on success. Raises `OutputError`, at once where it
    has content, unless `is_ours` allows that."""
    path = Path(path)
    if not _may_be_replaced(path, is_ours):
        raise OutputError(
            f"output folder exists and is not empty; remove it or name another: {path}"
        )
    with _beside(path, ".tmp", folder=True) as temporary:
        try:
            yield temporary
            temporary.chmod(0o777 & ~_umask())
            if is_ours is not None and path.exists() and is_ours(path):
                _remove_folder(path)
            elif path.exists():
                path.rmdir()  # refuses what appeared in it meanwhile
            temporary.replace(path)
        except OSError as error:
            cause = error.__cause__ if isinstance(error, OutputError) else error  # of a file in it
            if isinstance(error, MissingFileError) or not isinstance(cause, OSError):
                raise
            if cause.errno is None:
                raise
            raise _output_error(cause, path) from error


def require_writable(path: Path, *, folder: bool = False) -> None:
    """Raise `OutputError` where a file, or a `folder`, can surely not be written to `path`."""
    if path.exists() and not (path.is_dir() if folder else path.is_file()):
        kind = "a file" if folder else "a folder or a device"
        raise OutputError(f"cannot write over {kind}: {path}")
    path = Path(path).resolve()
    there = path if path.is_dir() else next(each for each in path.parents if each.exists())
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        why = "no permission, or a read-only disk" if there.is_dir() else "not a folder"
        raise OutputError(f"cannot write ({why}: {there}): {path}")
    disk = shutil.disk_usage(there)
    if disk.total and disk.free < _ALMOST_NONE:
        raise OutputError(f"disk full; nothing was written: {path}")


@contextmanager
def _beside(path: Path, suffix: str, *, folder: bool = False) -> Iterator[Path]:
    """A temporary file or folder beside `path`, removed in the end, as are folders that were made
    for it and stay empty."""
    missing: list[Path] = []
    make = tempfile.mkdtemp if folder else _made_file
    try:
        try:
            missing = [each for each in (path.parent, *path.parent.parents) if not each.exists()]
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = Path(make(prefix=f".{path.name}.", suffix=suffix, dir=path.parent))
        except OSError as error:
            raise _output_error(error, path) from error
        try:
            yield temporary
        finally:
            if folder:
                shutil.rmtree(temporary, ignore_errors=True)
            else:
                temporary.unlink(missing_ok=True)
    finally:
        with suppress(OSError):
            for each in missing:
                each.rmdir()


def _made_file(prefix: str, suffix: str, dir: Path) -> str:
    handle, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=dir)
    os.close(handle)
    return name


def not_written(reason: object, path: Path) -> OutputError:
    """The error of a library that gives no system error number, as GDAL does."""
    free = shutil.disk_usage(path.resolve().parent).free
    full = "disk full" if free < _ALMOST_NONE else "cannot write"
    said = " ".join(str(reason).split())[:200]
    return OutputError(f"{full} ({said}); nothing was written: {path}")


def _may_be_replaced(path: Path, is_ours: Callable[[Path], bool] | None) -> bool:
    try:
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return True
        return path.is_dir() and is_ours is not None and is_ours(path)
    except OSError as error:
        raise _output_error(error, path) from error


def _remove_folder(path: Path) -> None:
    """Remove a folder, out of sight first, so that a kill leaves no half of it."""
    aside = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".old", dir=path.parent))
    path.replace(aside)
    shutil.rmtree(aside, ignore_errors=True)


def is_stdout(path: Path) -> bool:
    return str(path) == "-"


def write_text(path: Path, text: str) -> None:
    write_lines(path, [text])


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write lines with their ends as UTF-8 to `path`, whole or not at all; `-` is stdout."""
    if is_stdout(path):
        sys.stdout.writelines(lines)
        return
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as out:
        out.writelines(lines)


def with_paths(record: object, *names: str) -> None:
    """Turn text fields of a frozen record into paths; None stays."""
    for name in names:
        value = getattr(record, name)
        if isinstance(value, str | os.PathLike):
            object.__setattr__(record, name, Path(value))
        elif value is not None:
            object.__setattr__(record, name, tuple(Path(each) for each in value))


def path_of(path: StrPath, what: str) -> Path:
    """Raises `ArgumentError` that names `what` for what is no path."""
    try:
        return Path(path)
    except TypeError as error:
        kind = type(path).__name__
        raise ArgumentError(f"{what} must be text or an os.PathLike, got {kind}") from error


def require_file(path: StrPath, what: str) -> Path:
    """`path` if it is a file and no pointer of Git LFS, else `MissingFileError` naming `what`."""
    path = path_of(path, what)
    if not path.is_file():
        kind = "is a folder, not a file" if path.is_dir() else "does not exist"
        raise MissingFileError(f"{what} {kind}: {path}")
    try:
        with path.open("rb") as stream:
            pointer = lfs_pointer(stream.read(64))
    except OSError:
        return path  # the reader says why
    if pointer:
        raise MissingFileError(f"{what} {pointer}: {path}")
    return path


def _sync(path: Path) -> None:
    with path.open("rb") as stream:
        os.fsync(stream.fileno())


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _output_error(error: OSError, path: Path) -> OutputError:
    if error.errno == errno.ENOSPC:
        return OutputError(f"disk full; nothing was written: {path}")
    return OutputError(f"cannot write ({error.strerror or error}): {path}")
