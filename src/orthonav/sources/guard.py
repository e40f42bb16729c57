"""Libraries that are loaded when they are needed, and what they raise turned into one line."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from orthonav import extras
from orthonav.errors import FlightError, OrthonavError


def needed(module: str, what: str) -> Any:
    """The module of that name. Raises `MissingExtraError` naming the extra that brings it."""
    return extras.needed(module, "flights", f"reading {what}")


@contextlib.contextmanager
def reading(what: str, path: Path, *, silent: bool = False) -> Iterator[None]:
    """Whatever a library raises inside becomes a `FlightError` that names `what` and `path`.

    With `silent`, what the library prints is dropped (some tell of damage line by line).
    """
    try:
        with _silence() if silent else contextlib.nullcontext():
            yield
    except OrthonavError:
        raise
    except Exception as error:
        told = " ".join(str(error).split())[:200] or "no more is known"
        raise FlightError(
            f"{what} cannot be read ({type(error).__name__}: {told}): {path}"
        ) from error


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Drop what is written to stdout and stderr, by C code too, by the whole process meanwhile."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        with (
            open(os.devnull, "w", encoding="utf-8") as nowhere,  # noqa: PTH123
            contextlib.redirect_stdout(nowhere),
            contextlib.redirect_stderr(nowhere),
        ):
            os.dup2(sink, 1)
            os.dup2(sink, 2)
            yield
    finally:
        for number, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, number)
            os.close(copy)
        os.close(sink)
