"""Solutions of GNSS receivers: the record, and `gnss.csv` of a flight folder."""

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from orthonav.core.errors import FlightError
from orthonav.core.files import replacing, require_file
from orthonav.core.flight.folder import check_latlon, csv_rows, number_of, time_ns_of
from orthonav.core.records import Evidence

FILE = "gnss.csv"
FIX_3D = 3  # GPS_FIX_TYPE of MAVLink from which a position is three-dimensional


class Fault(Enum):
    """A fault of GNSS, by its reason in health, logs and pages; in order of priority."""

    LOST = "gnss_lost"  # no messages, no 3D fix, or a useless stated accuracy
    FROZEN = "gnss_frozen"  # position or timestamp stands still while the aircraft moves
    JUMP = "gnss_jump"  # the position jumps against the receiver's own velocity
    STEP = "gnss_step"  # the difference from the map changed within seconds
    DRIFT = "gnss_drift"  # the difference from the map grows
    VELOCITY = "gnss_velocity"  # the velocity contradicts the positions of the receiver
    OFFSET = "gnss_offset"  # the difference is too large, and did not begin within the window
    DISAGREES = "gnss_disagrees"  # it changed, but the map jumped too: which is wrong is unknown


RETURNING = "gnss_returning"  # GNSS agrees again, but not yet for long enough
FAULTS = (*(each.value for each in Fault), RETURNING)
"""Reasons by the code, from 1, that evidence has as `gnss_fault`; 0 is none (docs/gnss.md)."""
BIASES = (
    ("gnss_map_east_m", "gnss_map_east_std_m"),
    ("gnss_map_north_m", "gnss_map_north_std_m"),
    ("gnss_mount_pitch_deg", "gnss_mount_pitch_std_deg"),
    ("gnss_mount_roll_deg", "gnss_mount_roll_std_deg"),
    ("gnss_latency_ms", "gnss_latency_std_ms"),
)
"""Keys in evidence of the learnt biases of GNSS minus map, and of their standard deviations."""
COLUMNS = ("time_s", "lat_deg", "lon_deg", "fix_type")
OPTIONAL_COLUMNS = (
    *("solved_s", "std_m", "vel_east_mps", "vel_north_mps"),
    *("satellites", "receiver"),
)


@dataclass(frozen=True)
class GnssSample:
    """Solution of a GNSS receiver, for comparison with positions by the map."""

    time_ns: int  # of the solution, by the clock of the exposures
    arrived_ns: int  # by the same clock
    lat_deg: float  # WGS84
    lon_deg: float
    fix_type: int  # as GPS_FIX_TYPE of MAVLink: `FIX_3D` or more is a 3D fix
    std_m: float = math.nan  # stated horizontal standard deviation; NaN where not known
    vel_en_mps: tuple[float, float] | None = None
    """Velocity over ground (Doppler), true east and north; None where not known."""
    satellites: int = -1  # number used; -1 where not known
    stamp_ns: int | None = None
    """The receiver's own timestamp, whatever its epoch; None where it has none."""
    receiver: int = 0  # 0 for the first, 1 for the second

    @property
    def has_fix(self) -> bool:
        """Whether the receiver reports a 3D fix."""
        return self.fix_type >= FIX_3D

    @property
    def is_valid(self) -> bool:
        """Whether it has a fix with a latitude and longitude in range."""
        return self.has_fix and abs(self.lat_deg) <= 90 and abs(self.lon_deg) <= 360  # NaN too


def gnss_of(evidence: Evidence) -> tuple[float, float] | None:
    """Latitude and longitude of GNSS at the exposure of a view; None where not known."""
    lat, lon = (evidence.get(f"gnss_{name}_deg", math.nan) for name in ("lat", "lon"))
    return (lat, lon) if abs(lat) <= 90 and abs(lon) <= 360 else None


def fault_of(evidence: Evidence) -> str:
    """Reason of the GNSS monitor at a view; "" without a fault."""
    code = evidence.get("gnss_fault", 0.0)
    return FAULTS[int(code) - 1] if 1 <= code <= len(FAULTS) else ""


def biases_of(evidence: Evidence) -> dict[str, float]:
    """Learnt biases of GNSS minus map and their standard deviations, by the keys of `BIASES`; empty
    unless all are known."""
    found = {key: evidence.get(key, math.nan) for pair in BIASES for key in pair}
    return found if all(map(math.isfinite, found.values())) else {}


def write_gnss(path: Path, samples: Iterable[GnssSample]) -> None:
    """Write `gnss.csv`, whole or not at all."""
    with replacing(path) as temporary, temporary.open("w", encoding="ascii", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow([*COLUMNS, *OPTIONAL_COLUMNS])
        for each in samples:
            velocity = each.vel_en_mps or (math.nan, math.nan)
            solved = "" if each.stamp_ns is None else f"{each.stamp_ns / 1e9:.3f}"
            place = f"{each.lat_deg:.8f}", f"{each.lon_deg:.8f}"
            numbers = [f"{value:.3f}" for value in (each.std_m, *velocity)]
            more = [each.satellites, each.receiver]
            writer.writerow(
                [f"{each.arrived_ns / 1e9:.3f}", *place, each.fix_type, solved, *numbers, *more]
            )


def read_gnss(path: Path) -> list[GnssSample]:
    """Solutions of a `gnss.csv` in the order of the file.

    Raises `MissingFileError`, or `FlightError`, which names the line.
    """
    path = require_file(path, "solutions of a GNSS receiver")
    return [_sample(line, row, path) for line, row in csv_rows(path, COLUMNS)]


def _sample(line: int, row: Mapping[str, str], path: Path) -> GnssSample:
    arrived_ns, solved_ns = time_ns_of(row["time_s"]), time_ns_of(row.get("solved_s"))
    number = {name: number_of(row.get(name)) for name in (*COLUMNS, *OPTIONAL_COLUMNS)}
    fix_type, satellites = number["fix_type"], number["satellites"]
    if arrived_ns is None or not 0 <= fix_type < 256:
        raise FlightError(f"line {line}: time_s or fix_type is not a number: {path}")
    if fix_type >= FIX_3D:
        check_latlon(number["lat_deg"], number["lon_deg"], line, path)
    velocity = number["vel_east_mps"], number["vel_north_mps"]
    return GnssSample(
        time_ns=arrived_ns if solved_ns is None else solved_ns,
        arrived_ns=arrived_ns,
        lat_deg=number["lat_deg"],
        lon_deg=number["lon_deg"],
        fix_type=int(fix_type),
        std_m=number["std_m"],
        vel_en_mps=velocity if all(map(math.isfinite, velocity)) else None,
        satellites=int(satellites) if math.isfinite(satellites) else -1,
        stamp_ns=solved_ns,
        receiver=int(number["receiver"] == 1),
    )
