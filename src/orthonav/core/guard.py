"""Optional libraries imported on demand, and their exceptions turned into one-line errors."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from orthonav.core import extras
from orthonav.core.errors import FlightError, OrthonavError


def needed(module: str, what: str) -> Any:
    return extras.needed(module, "flights", f"reading {what}")


@contextlib.contextmanager
def reading(what: str, path: Path, *, silent: bool = False) -> Iterator[None]:
    """Turns any exception of a library into a `FlightError`; `silent` drops its output."""
    try:
        with _silence() if silent else contextlib.nullcontext():
            yield
    except OrthonavError:
        raise
    except Exception as error:
        message = without_plea(" ".join(str(error).split()))[:200] or "no details"
        raise FlightError(
            f"{what} cannot be read ({type(error).__name__}: {message}): {path}"
        ) from error


def without_plea(message: str) -> str:
    """Without a library's request to report the error to its authors."""
    return message.partition("; please report")[0]


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Drops stdout and stderr of the whole process, those of C code too."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [os.dup(1), os.dup(2)]
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        with (
            Path(os.devnull).open("w", encoding="utf-8") as nowhere,
            contextlib.redirect_stdout(nowhere),
            contextlib.redirect_stderr(nowhere),
        ):
            os.dup2(sink, 1)
            os.dup2(sink, 2)
            yield
    finally:
        for number, copy in zip((1, 2), saved, strict=True):
            os.dup2(copy, number)
            os.close(copy)
        os.close(sink)
