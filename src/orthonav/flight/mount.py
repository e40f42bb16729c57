"""What is wrong with what a flight tells, all along: how the camera is mounted, compass, height.

Found by flying (`orthonav calibrate`), kept in a small JSON file, used for the flights after it.
"""

import json
import math
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from orthonav.errors import FlightError
from orthonav.files import require_file, write_text
from orthonav.records import Telemetry

VERSION = 1
MAX_BYTES = 100_000
BROKEN = (KeyError, TypeError, ValueError, OverflowError)
_LIMITS = {"heading_deg": 180.0, "log_scale": 1.0, "pitch_deg": 60.0, "roll_deg": 60.0}


@dataclass(frozen=True)
class Bias:
    """A constant error: `value` is added to what is told, `std` how well it is known, `scatter`
    the standard deviation of what is left from view to view."""

    value: float
    std: float
    scatter: float


@dataclass(frozen=True)
class Mount:
    """Constant errors of what is told.

    `heading_deg`, `pitch_deg` and `roll_deg` in degrees, clockwise, ahead and to the left as those
    of `Telemetry`; `log_scale` is the natural logarithm of true over told height, errors of the
    focal length included. `views`: how many it rests on.
    """

    heading_deg: Bias
    log_scale: Bias
    pitch_deg: Bias
    roll_deg: Bias
    views: int

    def corrected(self, telemetry: Telemetry) -> Telemetry:
        """Telemetry without these errors; what is not told stays so."""
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
            raise ValueError("it is too large")
        plain = json.loads(path.read_text(encoding="utf-8"))
        if plain["orthonav_mount"] != VERSION:
            raise ValueError(f"version {plain['orthonav_mount']}, expected {VERSION}")
        return mount_from_plain(plain)
    except (*BROKEN, AttributeError, RecursionError, OSError) as error:
        raise FlightError(f"not a mount file of `orthonav calibrate` ({error}): {path}") from error


def mount_from_plain(plain: Any) -> Mount:
    """Inverse of `asdict`, checked; raises one of `BROKEN` where it is no mount."""
    biases = {name: _bias(plain[name], name) for name in _LIMITS}
    return Mount(**biases, views=int(plain["views"]))


def _bias(plain: dict[str, Any], name: str) -> Bias:
    bias = Bias(*(float(plain[each.name]) for each in fields(Bias)))
    limit = _LIMITS[name]
    if not (abs(bias.value) <= limit and 0 <= bias.std <= limit and 0 <= bias.scatter <= limit):
        raise ValueError(f"{name} out of range")
    return bias
