"""Latency of a camera, from exposure to arrival, as `orthonav calibrate --latency` writes it."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from orthonav.core.flight.calibrated import read_record, write_record

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
    write_record(path, "latency", asdict(latency))


def read_latency(path: Path) -> CameraLatency:
    """Read what `write_latency` wrote. Raises `MissingFileError` or `FlightError`."""
    return read_record(path, "latency", "orthonav calibrate --latency", _from_plain)


def _from_plain(plain: Any) -> CameraLatency:
    found = CameraLatency(float(plain["latency_ms"]), float(plain["std_ms"]), int(plain["pairs"]))
    if not (0 <= found.latency_ms <= MOST_MS and 0 <= found.std_ms < math.inf):
        raise ValueError("latency out of range")
    return found
