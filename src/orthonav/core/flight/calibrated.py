"""The small JSON files that `orthonav calibrate` writes: a version and the fields of one record."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from orthonav.core.errors import FlightError, described
from orthonav.core.files import require_file, write_text

VERSION = 1
MAX_BYTES = 100_000
BROKEN = (KeyError, TypeError, ValueError, OverflowError)
Record = TypeVar("Record")


def write_record(path: Path, kind: str, fields: Mapping[str, Any]) -> None:
    """Write fields as JSON with the version in `orthonav_{kind}`, whole or not at all."""
    plain = {f"orthonav_{kind}": VERSION, **fields}
    write_text(path, json.dumps(plain, indent=1, allow_nan=False) + "\n")


def read_record(path: Path, kind: str, command: str, from_plain: Callable[[Any], Record]) -> Record:
    """Read what `write_record` wrote by `command`; `from_plain` raises one of `BROKEN`.

    Raises `MissingFileError` or `FlightError`.
    """
    path = require_file(path, f"{kind} file")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError("too large")
        plain = json.loads(path.read_text(encoding="utf-8"))
        if plain[f"orthonav_{kind}"] != VERSION:
            raise ValueError(f"version {plain[f'orthonav_{kind}']}, expected {VERSION}")
        return from_plain(plain)
    except (*BROKEN, AttributeError, RecursionError, OSError) as error:
        raise FlightError(
            f"not a {kind} file of `{command}` ({described(error)}): {path}"
        ) from error
