"""Constant errors of a flight's telemetry, and the latency of its camera.

`orthonav calibrate` estimates them and writes small JSON files for later flights.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from orthonav.core.errors import FlightError, described
from orthonav.core.files import require_file, write_text
from orthonav.core.flight.folder import BROKEN
from orthonav.core.records import Telemetry

_LIMITS = {"heading_deg": 180.0, "log_scale": 1.0, "pitch_deg": 60.0, "roll_deg": 60.0}
MOST_MS = 12_000.0
VERSION = 1
Record = TypeVar("Record")


@dataclass(frozen=True)
class Bias:
    """A constant error: `value` is added to the reported value, `std` is the standard deviation of
    the estimate, `scatter` that of the residuals from view to view."""

    value: float
    std: float
    scatter: float


@dataclass(frozen=True)
class Mount:
    """Constant errors of telemetry."""

    heading_deg: Bias  # degrees, clockwise
    log_scale: Bias
    """Natural logarithm of true over reported height; includes errors of the focal length."""
    pitch_deg: Bias  # degrees, positive ahead
    roll_deg: Bias  # degrees, positive to the left
    views: int  # number of views that the estimate is based on

    def corrected(self, telemetry: Telemetry) -> Telemetry:
        """Telemetry without these errors; unknown values stay unknown.

        What the calibration does not know of the mount adds to the stated deviation of pitch and
        roll, in place of the part of a mount that was never calibrated.
        """
        tilt = telemetry.horizon_std_deg
        mount = max(self.pitch_deg.std, self.roll_deg.std)
        return replace(
            telemetry,
            yaw_deg=telemetry.yaw_deg + self.heading_deg.value,
            agl_m=telemetry.agl_m * math.exp(self.log_scale.value),
            pitch_deg=telemetry.pitch_deg + self.pitch_deg.value,
            roll_deg=telemetry.roll_deg + self.roll_deg.value,
            tilt_std_deg=None if tilt is None else math.hypot(tilt, mount),
            mount_std_deg=None if tilt is None else mount,
        )


def write_mount(path: Path, mount: Mount) -> None:
    """Write a mount as JSON, whole or not at all."""
    _write(path, "mount", asdict(mount))


def read_mount(path: Path) -> Mount:
    """Read what `write_mount` wrote. Raises `MissingFileError` or `FlightError`."""
    return _read(path, "mount", "orthonav calibrate", mount_from_plain)


def mount_from_plain(plain: Any) -> Mount:
    """Inverse of `asdict`, checked; raises one of `BROKEN` for an invalid mount."""
    biases = {name: _bias(plain[name], name) for name in _LIMITS}
    return Mount(**biases, views=int(plain["views"]))


def logged_mount(options: Mapping[str, Any]) -> Mount | None:
    """The mount among the options of a flight log, None for none. Raises `FlightError`."""
    plain = options.get("mount")
    try:
        return None if plain is None else mount_from_plain(plain)
    except BROKEN as error:
        raise FlightError(f"flight log: invalid mount ({described(error)})") from error


def _bias(plain: dict[str, Any], name: str) -> Bias:
    bias = Bias(*(float(plain[each.name]) for each in fields(Bias)))
    limit = _LIMITS[name]
    if not (abs(bias.value) <= limit and 0 <= bias.std <= limit and 0 <= bias.scatter <= limit):
        raise ValueError(f"{name} out of range")
    return bias


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
    _write(path, "latency", asdict(latency))


def read_latency(path: Path) -> CameraLatency:
    """Read what `write_latency` wrote. Raises `MissingFileError` or `FlightError`."""
    return _read(path, "latency", "orthonav calibrate --latency", _latency)


def _latency(plain: Any) -> CameraLatency:
    found = CameraLatency(float(plain["latency_ms"]), float(plain["std_ms"]), int(plain["pairs"]))
    if not (0 <= found.latency_ms <= MOST_MS and 0 <= found.std_ms < math.inf):
        raise ValueError("latency out of range")
    return found


def _write(path: Path, kind: str, fields: Mapping[str, Any]) -> None:
    plain = {f"orthonav_{kind}": VERSION, **fields}
    write_text(path, json.dumps(plain, indent=1, allow_nan=False) + "\n")


def _read(path: Path, kind: str, command: str, from_plain: Callable[[Any], Record]) -> Record:
    """What `command` wrote; `from_plain` raises one of `BROKEN` for impossible values."""
    path = require_file(path, f"{kind} file")
    try:
        if path.stat().st_size > 100_000:
            raise ValueError("too large")
        plain = json.loads(path.read_text(encoding="utf-8"))
        if plain[f"orthonav_{kind}"] != VERSION:
            raise ValueError(f"version {plain[f'orthonav_{kind}']}, expected {VERSION}")
        return from_plain(plain)
    except (*BROKEN, OSError) as error:
        raise FlightError(
            f"not a {kind} file of `{command}` ({described(error)}): {path}"
        ) from error
