"""Measurements along a flight as time series, and telemetry interpolated at any time."""

import math
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.flight.recording import NO_SOURCE, chosen
from orthonav.core.geo.attitude import matrices_of_wxyz, slerp, wxyz_of_matrices
from orthonav.core.geo.camera import attitude_of
from orthonav.core.geo.frames import wrapped_deg
from orthonav.core.records import Prior, Telemetry
from orthonav.core.tilt import AUTOPILOT, TiltSource

Array = NDArray[np.float64]
DAY_NS = 86_400 * 10**9
"""Samples farther than this from the median time are damaged, or of a clock that was not set."""
LATEST_NS = 2**62  # latest valid time (the year 2116): leaves room for offsets in 64 bits
GAP_NS = 2_000_000_000  # longest gap that is interpolated: an aircraft may turn and climb meanwhile


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """Values (N, D) at increasing times (N,) in integer ns."""

    time_ns: NDArray[np.int64]
    values: Array

    def around(self, time_ns: int) -> tuple[int, int, float] | None:
        """The samples before and after a time and the weight of the later one.

        None outside the series and within gaps of more than `GAP_NS`.
        """
        after = int(np.searchsorted(self.time_ns, time_ns))
        if after < len(self.time_ns) and self.time_ns[after] == time_ns:
            return after, after, 0.0
        if after in (0, len(self.time_ns)):
            return None
        start, end = int(self.time_ns[after - 1]), int(self.time_ns[after])
        if end - start > GAP_NS:
            return None
        return after - 1, after, (time_ns - start) / (end - start)

    def at(self, time_ns: int) -> Array:
        """Values (D,) at a time, linear between samples; NaN where they are unknown."""
        found = self.around(time_ns)
        if found is None:
            return np.full(self.values.shape[1], np.nan)
        before, after, weight = found
        return np.asarray((1 - weight) * self.values[before] + weight * self.values[after])

    def mean(self, start_ns: int, end_ns: int) -> Array:
        """Mean values (D,) from a time to a later one; NaN where they are unknown in between."""
        inner = (self.time_ns > start_ns) & (self.time_ns < end_ns)
        times = np.array([start_ns, *self.time_ns[inner].tolist(), end_ns])
        steps = np.diff(times)
        if steps.max() > GAP_NS:
            return np.full(self.values.shape[1], np.nan)
        values = np.stack([self.at(start_ns), *self.values[inner], self.at(end_ns)])
        return np.average((values[1:] + values[:-1]) / 2, axis=0, weights=steps)


class Samples:
    """Collects samples in any order; `series` sorts them and drops those that are not finite."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._times = array("q")
        self._values = array("d")

    def add(self, time_ns: int, *values: float) -> None:
        """One sample; an impossible time (a damaged message) is dropped."""
        if abs(time_ns) > LATEST_NS:
            return
        self._times.append(time_ns)
        self._values.extend(values)

    def arrays(self) -> tuple[NDArray[np.int64], Array]:
        """Times (N,) and values (N, D), in the order of `add`."""
        return np.array(self._times, dtype=np.int64), np.array(self._values).reshape(
            -1, self._width
        )

    def series(self) -> TimeSeries | None:
        """The series, or None where there is no sample. The first of equal times counts."""
        return series_of(*self.arrays())

    def positions(self) -> TimeSeries | None:
        """The same of (lat_deg, lon_deg, alt_m): see `position_series`."""
        return position_series(*self.arrays())


def series_of(time_ns: NDArray[np.int64], values: Array) -> TimeSeries | None:
    """A series from times (N,) and values (N, D) in any order; None where none is finite."""
    return _sorted(time_ns, values, np.asarray(np.isfinite(values).all(axis=1)))


def attitude_series(
    time_ns: NDArray[np.int64], rotations: Array, known: NDArray[np.bool_] | None = None
) -> TimeSeries | None:
    """An attitude series from `enu_from_camera` (N, 3, 3) and whether its heading is known (N,)."""
    if len(time_ns) == 0:
        return None
    quaternions = wxyz_of_matrices(rotations)
    flags = np.ones(len(time_ns)) if known is None else known.astype(np.float64)
    return series_of(time_ns, np.column_stack([quaternions, flags]))


def attitude_of_angles(
    samples: Samples, enu_from_angles: Callable[[Array], Array]
) -> TimeSeries | None:
    """An attitude series from samples of yaw, pitch, roll in degrees and their convention.

    A heading of NaN is marked as unknown; samples without pitch and roll are dropped.
    """
    times, angles = samples.arrays()
    sound = np.isfinite(angles[:, 1:]).all(axis=1)
    known = np.isfinite(angles[sound, 0])
    turns = np.where(np.isfinite(angles[sound]), angles[sound], 0.0)
    return attitude_series(times[sound], enu_from_angles(turns), known) if sound.any() else None


def position_series(time_ns: NDArray[np.int64], latlonalt: Array) -> TimeSeries | None:
    """A series of (lat_deg, lon_deg, alt_m) that crosses the 180th meridian on the shorter side.

    Altitudes may be NaN. Samples at 0, 0 are dropped: recorders write that for "no position".
    """
    sound = np.isfinite(latlonalt[:, :2]).all(axis=1) & latlonalt[:, :2].any(axis=1)
    series = _sorted(time_ns, latlonalt, np.asarray(sound))
    if series is not None:
        series.values[:, 1] = np.unwrap(series.values[:, 1], period=360)
    return series


def altitude_series(position: TimeSeries | None) -> TimeSeries | None:
    """The altitudes (N, 1) of a series of positions where they are known."""
    return None if position is None else series_of(position.time_ns, position.values[:, 2:3])


def _sorted(
    time_ns: NDArray[np.int64], values: Array, sound: NDArray[np.bool_]
) -> TimeSeries | None:
    if not sound.any():
        return None
    near = np.abs(time_ns - np.median(time_ns[sound])) < DAY_NS
    times, first = np.unique(time_ns[sound & near], return_index=True)
    return TimeSeries(times, values[sound & near][first])


@dataclass(frozen=True, eq=False)
class RecordedTrack:
    """Measurements along a flight; a series that is None was not recorded."""

    attitude: TimeSeries | None
    """Quaternion w, x, y, z of `enu_from_camera`, and 1 where its heading is known."""
    heights: tuple[TimeSeries, ...] = ()
    """Metres above ground, as measured; of several series the more accurate first."""
    home: TimeSeries | None = None  # metres above the place of take-off
    amsl: TimeSeries | None = None  # metres above mean sea level
    hae: TimeSeries | None = None  # metres above the ellipsoid of WGS 84
    position: TimeSeries | None = None
    """Latitude and longitude in degrees, and the altitude in metres, whose reference differs."""
    velocity: TimeSeries | None = None  # east and north, m/s
    yaw_std: TimeSeries | None = None  # reported standard deviation of the heading, degrees
    agl_std: TimeSeries | None = None  # reported standard deviation of the height, metres
    tilt_std: TimeSeries | None = None  # reported standard deviation of pitch and roll, degrees
    mount_std: TimeSeries | None = None  # reported part of it of a mount never calibrated, degrees
    horizon_std: TimeSeries | None = None  # reported standard deviation of the horizon, degrees
    tilt: TiltSource = AUTOPILOT
    """Source of the attitude, which says what was not reported."""
    prior: TimeSeries | None = None
    """Reported prior: latitude, longitude in degrees, standard deviation in metres."""
    zoomed: TimeSeries | None = None  # 1 at another zoom than most of the time, else 0
    origin_ns: int = 0  # time at which a recording without a clock begins
    warnings: tuple[str, ...] = ()  # doubts about the log, for people
    choices: tuple[str, ...] = ()  # what was used where the log has several, by `chosen`

    @cached_property
    def altitude(self) -> TimeSeries | None:
        """Altitudes of one reference: as recorded with positions, else above mean sea level."""
        recorded = altitude_series(self.position)
        return self.amsl if recorded is None else recorded

    @property
    def take_off_latlon_deg(self) -> tuple[float, float] | None:
        """The first position, taken as that of take-off; None without positions."""
        return None if self.position is None else self.latlon_deg(int(self.position.time_ns[0]))

    def span_ns(self) -> tuple[int, int] | None:
        """First and last time of its attitude or, without any, of heights or positions."""
        recorded = (self.attitude, *self.heights, self.home, self.position)
        series = next((one for one in recorded if one is not None), None)
        return None if series is None else (int(series.time_ns[0]), int(series.time_ns[-1]))

    def telemetry(self, time_ns: int, ground_alt_m: float | None = None) -> Telemetry:
        """Telemetry at a time; `ground_alt_m` gives a height where only the altitude is known.

        Where no height above ground was measured, it is the one above take-off.
        """
        yaw, pitch, roll = angles_at(self.attitude, time_ns)
        series = {"yaw_std_deg": self.yaw_std, "agl_std_m": self.agl_std}
        series |= {"home_m": self.home, "amsl_m": self.amsl, "hae_m": self.hae}
        optional: dict[str, Any] = {name: _at(each, time_ns)[0] for name, each in series.items()}
        if math.isfinite(pitch + roll):
            optional |= self._tilt_stds(time_ns)
        return Telemetry(
            time_ns,
            yaw,
            pitch,
            roll,
            self._agl_m(time_ns, ground_alt_m),
            prior=Prior.known(*_at(self.prior, time_ns, 3)),
            vel_en_mps=_known_pair(_at(self.velocity, time_ns, 2)),
            **optional,
        )

    def mean_velocity_en_mps(self, start_ns: int, end_ns: int) -> tuple[float, float] | None:
        """Mean velocity from a time to a later one; None where it is unknown in between.

        Without a sample in between it is the one at the end: a log with a row for each view.
        """
        series = self.velocity
        if series is None:
            return None
        between = (series.time_ns > start_ns) & (series.time_ns < end_ns)
        mean = series.mean(start_ns, end_ns) if between.any() else series.at(end_ns)
        return _known_pair(mean.tolist())

    def latlon_deg(self, time_ns: int) -> tuple[float, float] | None:
        """Position by the aircraft's own GNSS receiver, or None."""
        lat, lon, _ = _at(self.position, time_ns, 3)
        return _known_pair((lat, wrapped_deg(lon)))

    def _tilt_stds(self, time_ns: int) -> dict[str, Any]:
        """Fields of the telemetry. A position says that GNSS aids the horizon."""
        stated, mount, horizon = (
            _at(each, time_ns)[0] for each in (self.tilt_std, self.mount_std, self.horizon_std)
        )
        if math.isfinite(stated):
            return {"tilt_std_deg": stated, "mount_std_deg": mount}
        if math.isfinite(horizon):
            return self.tilt.with_horizon(horizon)
        return self.tilt.stated(aided=self.latlon_deg(time_ns) is not None)

    def _agl_m(self, time_ns: int, ground_alt_m: float | None) -> float:
        heights = (measured(_at(each, time_ns)[0]) for each in (*self.heights, self.home))
        altitude = math.nan if ground_alt_m is None else _at(self.altitude, time_ns)[0]
        otherwise = altitude - (ground_alt_m or 0.0)
        return next(filter(math.isfinite, heights), otherwise)


def angles_at(attitude: TimeSeries | None, time_ns: int) -> tuple[float, float, float]:
    """Heading, pitch and roll of the camera at a time, by spherical interpolation.

    Where a neighbouring sample has no heading, the nearer sample is used and the heading is NaN.
    """
    found = None if attitude is None else attitude.around(time_ns)
    if attitude is None or found is None:
        return math.nan, math.nan, math.nan
    before, after, weight = found
    ends = attitude.values[[before, after]]
    known = bool(ends[:, 4].all())
    if before == after or not known:
        wxyz = ends[int(weight > 0.5), :4]
    else:
        wxyz = slerp(ends[0, :4], ends[1, :4], weight)
    yaw, pitch, roll = attitude_of(matrices_of_wxyz(wxyz))
    return yaw if known else math.nan, pitch, roll


def _at(series: TimeSeries | None, time_ns: int, width: int = 1) -> list[float]:
    """The values of a series at a time; NaN where they are unknown."""
    found: list[float] = [math.nan] * width if series is None else series.at(time_ns).tolist()
    return found


def _known_pair(values: Sequence[float]) -> tuple[float, float] | None:
    first, second = values
    return (first, second) if math.isfinite(first + second) else None


class Sources:
    """The source of each role: as named, else the first without a fault, else with a value."""

    def __init__(self, named: Mapping[str, str], path: Path) -> None:
        self.named, self.path = named, path
        self.used: dict[str, str] = {}
        self.choices: tuple[str, ...] = ()  # by `chosen`

    def first(self, role: str, names: Iterable[str], read: Callable[[str], tuple[Any, str]]) -> Any:
        """The value of the source of a role; `read` gives the value and the fault of one.

        Raises `FlightError` where the named one is not among `names`.
        """
        held, named = list(names), self.named.get(role)
        if named not in (None, *held):
            known = f"available: {', '.join(held) or 'none'}"
            raise FlightError(f"no {named} for {role}; {known}: {self.path}")
        values, faults = dict[str, Any](), dict.fromkeys(held, "")
        for name in held if named is None else [named]:
            values[name], fault = read(name)
            faults[name] = fault if fault or values[name] is not None else "no valid message"
            if not faults[name]:
                break
        fit = [name for name, value in values.items() if value is not None]
        used = self.used[role] = min(fit, key=lambda name: faults[name] != "", default=NO_SOURCE)
        if named is not None and not fit:
            raise FlightError(f"{named} has no valid message for {role}: {self.path}")
        faults.pop(used, None)
        others = [f"{name} ({fault})" if fault else name for name, fault in faults.items()]
        if others and named is None:
            why = f"first that fits; --topic {role}=NAME selects another"
            self.choices += (chosen(role, used, others, why),)
        return values.get(used)

    def best(self, role: str, series: Mapping[str, TimeSeries | None]) -> TimeSeries | None:
        """As `first`: a series of less than half the time of another one has a fault."""
        held = {name: _seconds(one) for name, one in series.items()}
        most = max(held.values(), default=0)
        few = {name: f"valid for {s} s of {most} s" for name, s in held.items() if 0 < 2 * s < most}
        found: TimeSeries | None = self.first(role, series, lambda n: (series[n], few.get(n, "")))
        return found

    def all(
        self, role: str, series: Mapping[str, TimeSeries | None], faults: Mapping[str, str]
    ) -> tuple[TimeSeries, ...]:
        """The named series, else all with a value, that of the longest time first: the others are
        for its gaps. `faults`: of those that are None."""
        if role in self.named:
            return (self.first(role, series, lambda name: (series[name], "")),)
        held = {name: one for name, one in series.items() if one is not None}
        fit = sorted(held, key=lambda name: -_seconds(held[name]))
        others = [f"{n} ({faults.get(n) or 'no valid message'})" for n in series if n not in held]
        self.used[role] = fit[0] if fit else NO_SOURCE
        if len(fit) > 1 or others:
            used = ", in its gaps ".join(fit) or NO_SOURCE
            why = f"--topic {role}=NAME selects one"
            self.choices += (chosen(role, used, others, why),)
        return tuple(held[name] for name in fit)


def _seconds(series: TimeSeries | None) -> int:
    """Whole seconds with a sample."""
    return 0 if series is None else len(np.unique(series.time_ns // 10**9))


def measured(height_m: float) -> float:
    """A height, NaN for 0, which recorders write where they measured none."""
    return math.nan if height_m == 0 else height_m
