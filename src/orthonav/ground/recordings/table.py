"""Telemetry as a table over time, with the columns of a flight folder's `telemetry.csv`."""

import math
from collections.abc import Mapping
from pathlib import Path

from orthonav.core.errors import FlightError
from orthonav.core.flight.folder import number_of, time_ns_of
from orthonav.core.flight.telemetry_track import (
    RecordedTrack,
    Samples,
    TimeSeries,
    attitude_of_angles,
    measured,
)
from orthonav.core.geo.attitude import enu_from_body_camera, ned_from_angles
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.tables import TableError, TableRows

NEEDED = ("time_s", "pitch_deg", "roll_deg")
MAX_BYTES = 500_000_000
_NAMES = {
    "height": ("agl_m",),
    "home": ("home_m",),
    "amsl": ("amsl_m",),
    "hae": ("hae_m",),
    "velocity": ("vel_east_mps", "vel_north_mps"),
    "yaw_std": ("yaw_std_deg",),
    "agl_std": ("agl_std_m",),
    "tilt_std": ("tilt_std_deg",),
    "prior": ("prior_lat_deg", "prior_lon_deg", "prior_std_m"),
}
_HEIGHTS = ("height", "home", "amsl", "hae")


def read_table(path: Path) -> RecordedTrack:
    """The track of a CSV with `time_s` and the columns of a flight's telemetry, and, where it was
    recorded, `lat_deg,lon_deg`. Angles are those of the camera, in the convention of orthonav.

    Raises `FlightError`, with the line, for an invalid table.
    """
    if path.stat().st_size > MAX_BYTES:
        raise FlightError(f"file is larger than {MAX_BYTES // 10**6} MB: {path}")
    attitude, position = Samples(3), Samples(3)
    others = {name: Samples(len(columns)) for name, columns in _NAMES.items()}
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = TableRows(stream)
            missing = [name for name in NEEDED if name not in rows.columns]
            if missing:
                raise FlightError(f"columns are missing: {', '.join(missing)}: {path}")
            held = {
                name: columns
                for name, columns in _NAMES.items()
                if not set(columns).isdisjoint(rows.columns)
            }
            placed = not {"lat_deg", "prior_lat_deg"}.isdisjoint(rows.columns)
            for row in rows:
                time_ns = time_ns_of(row["time_s"])
                if time_ns is None:
                    raise FlightError(f"line {rows.line}: time_s is not a time: {path}")
                angles = (number_of(row.get(f"{name}_deg")) for name in ("yaw", "pitch", "roll"))
                attitude.add(time_ns, *angles)
                if placed:
                    position.add(time_ns, *_position(row, rows.line, path), math.nan)
                for name, columns in held.items():
                    values = [number_of(row.get(column)) for column in columns]
                    if name in _HEIGHTS:
                        values = [measured(value) for value in values]
                    others[name].add(time_ns, *values)
    except TableError as error:
        raise FlightError(f"{error}: {path}") from error
    return _track(attitude, position, others, path)


def _position(row: Mapping[str, str | None], line: int, path: Path) -> tuple[float, float]:
    """Latitude and longitude of a row; raises `FlightError` where they seem to be swapped."""
    lat_deg, lon_deg = number_of(row.get("lat_deg")), number_of(row.get("lon_deg"))
    prior = number_of(row.get("prior_lat_deg")), number_of(row.get("prior_lon_deg"))
    if hint := swapped_hint(lat_deg, lon_deg) or swapped_hint(*prior):
        raise FlightError(f"line {line}: position is out of range{hint}: {path}")
    return lat_deg, lon_deg


def _track(
    attitude: Samples, position: Samples, others: dict[str, Samples], path: Path
) -> RecordedTrack:
    found: dict[str, TimeSeries | None] = {name: each.series() for name, each in others.items()}
    height = found["height"]
    track = RecordedTrack(
        attitude=attitude_of_angles(
            attitude, lambda angles: enu_from_body_camera(ned_from_angles(angles))
        ),
        heights=() if height is None else (height,),
        home=found["home"],
        amsl=found["amsl"],
        hae=found["hae"],
        position=position.positions(),
        velocity=found["velocity"],
        yaw_std=found["yaw_std"],
        agl_std=found["agl_std"],
        tilt_std=found["tilt_std"],
        prior=found["prior"],
    )
    if track.attitude is None:
        raise FlightError(f"telemetry has no line with pitch and roll: {path}")
    return track
