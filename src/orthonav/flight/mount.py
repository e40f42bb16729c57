"""Constant errors of a flight's telemetry: mounting of the camera, compass, height, focal length.

`orthonav calibrate` estimates them from a flight and writes a small JSON file for later flights.
"""

import json
import math
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from orthonav.errors import FlightError, described
from orthonav.files import require_file, write_text
from orthonav.records import Telemetry

VERSION = 1
MAX_BYTES = 100_000
BROKEN = (KeyError, TypeError, ValueError, OverflowError)
_LIMITS = {"heading_deg": 180.0, "log_scale": 1.0, "pitch_deg": 60.0, "roll_deg": 60.0}


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

    heading_deg: Bias
    """Degrees, clockwise."""
    log_scale: Bias
    """Natural logarithm of true over reported height; includes errors of the focal length."""
    pitch_deg: Bias
    """Degrees, positive ahead."""
    roll_deg: Bias
    """Degrees, positive to the left."""
    views: int
    """Number of views that the estimate is based on."""

    def corrected(self, telemetry: Telemetry) -> Telemetry:
        """Telemetry without these errors; unknown values stay unknown."""
        return replace(
            telemetry,
            yaw_deg=telemetry.yaw_deg + self.heading_deg.value,
            agl_m=telemetry.agl_m * math.exp(self.log_scale.value),
            pitch_deg=telemetry.pitch_deg + self.pitch_deg.value,
            roll_deg=telemetry.roll_deg + self.roll_deg.value,
        )


def write_mount(path: Path, mount: Mount) -> None:
    """Write a mount as JSON, whole or not at all."""
    plain = {"orthonav_mount": VERSION, **asdict(mount)}
    write_text(path, json.dumps(plain, indent=1, allow_nan=False) + "\n")


def read_mount(path: Path) -> Mount:
    """Read what `write_mount` wrote. Raises `MissingFileError` or `FlightError`."""
    path = require_file(path, "mount file")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError("too large")
        plain = json.loads(path.read_text(encoding="utf-8"))
        if plain["orthonav_mount"] != VERSION:
            raise ValueError(f"version {plain['orthonav_mount']}, expected {VERSION}")
        return mount_from_plain(plain)
    except (*BROKEN, AttributeError, RecursionError, OSError) as error:
        raise FlightError(
            f"not a mount file of `orthonav calibrate` ({described(error)}): {path}"
        ) from error


def mount_from_plain(plain: Any) -> Mount:
    """Inverse of `asdict`, checked; raises one of `BROKEN` for an invalid mount."""
    biases = {name: _bias(plain[name], name) for name in _LIMITS}
    return Mount(**biases, views=int(plain["views"]))


def _bias(plain: dict[str, Any], name: str) -> Bias:
    bias = Bias(*(float(plain[each.name]) for each in fields(Bias)))
    limit = _LIMITS[name]
    if not (abs(bias.value) <= limit and 0 <= bias.std <= limit and 0 <= bias.scatter <= limit):
        raise ValueError(f"{name} out of range")
    return bias
