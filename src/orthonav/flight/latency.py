"""Latency of a camera, from exposure to arrival, as `orthonav calibrate --latency` writes it."""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path

from orthonav.errors import FlightError
from orthonav.files import require_file, write_text

VERSION = 1
MAX_BYTES = 100_000
MOST_MS = 12_000.0


@dataclass(frozen=True)
class CameraLatency:
    """Time from exposure to arrival.

    `latency_ms`, `std_ms`: its value and standard deviation. `pairs`: number of pairs of images
    that it was measured with; 0 where it was stated.
    """

    latency_ms: float
    std_ms: float
    pairs: int = 0


def write_latency(path: Path, latency: CameraLatency) -> None:
    """Write a latency as JSON, whole or not at all."""
    plain = {"orthonav_latency": VERSION, **asdict(latency)}
    write_text(path, json.dumps(plain, indent=1, allow_nan=False) + "\n")


def read_latency(path: Path) -> CameraLatency:
    """Read what `write_latency` wrote. Raises `MissingFileError` or `FlightError`."""
    path = require_file(path, "latency file")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError("too large")
        plain = json.loads(path.read_text(encoding="utf-8"))
        if plain["orthonav_latency"] != VERSION:
            raise ValueError(f"version {plain['orthonav_latency']}, expected {VERSION}")
        found = CameraLatency(
            float(plain["latency_ms"]), float(plain["std_ms"]), int(plain["pairs"])
        )
        if not (0 <= found.latency_ms <= MOST_MS and 0 <= found.std_ms < math.inf):
            raise ValueError("latency out of range")
    except (ArithmeticError, LookupError, TypeError, ValueError, RecursionError, OSError) as error:
        raise FlightError(
            f"not a latency file of `orthonav calibrate --latency` ({error}): {path}"
        ) from error
    return found
